"""Compare the pieces of a cloud on disk with `read_cloud`."""

import pickle

import numpy as np

from pcbench.io import read_cloud
from pcbench.io.pieces import open_cloud, read_piece, reading_warnings


def check_pieces(path, piece_points=1000, **filters):
    """Check that the pieces of a path are the cloud of `read_cloud`, bit by bit, with the same warnings.

    Returns:
        The cloud on disk and the cloud of `read_cloud`.
    """
    lines = []
    cloud = read_cloud(path, on_warning=lines.append, **filters)
    disk = pickle.loads(pickle.dumps(open_cloud(path, piece_points=piece_points, **filters)))
    assert [piece.number for piece in disk.pieces] == list(range(len(disk.pieces)))
    read = [read_piece(disk.without_pieces(), piece) for piece in disk.pieces]
    assert np.concatenate([piece.points for piece in read]).tobytes() == cloud.points.tobytes()
    assert disk.has_normals == (cloud.normals is not None)
    if cloud.normals is not None:
        assert np.concatenate([piece.normals for piece in read]).tobytes() == cloud.normals.tobytes()
    else:
        assert all(piece.normals is None for piece in read)
    if all(piece.classification is not None for piece in read):
        classification = np.concatenate([piece.classification for piece in read])
        np.testing.assert_array_equal(classification, cloud.attributes["classification"])
    assert (disk.crs, disk.unit) == (cloud.crs, cloud.unit)
    notes = [(piece, points.notes) for piece, points in zip(disk.pieces, read, strict=True)]
    # Pieces have neither attributes nor colours.
    lines = {line for line in lines if "left out what" not in line and "colours are" not in line}
    assert {*disk.warnings, *reading_warnings(disk, notes)} == lines
    assert disk.count == sum(file.count for file in disk.files) == sum(piece.count for piece in disk.pieces)
    return disk, cloud
