"""Sources: a path is resolved once, and the header of each file is read once."""

import io
from collections import Counter
from functools import partial
from pathlib import Path

import las_bytes
import numpy as np
import ply_bytes
import pytest
from wording import check_error

from pcbench.errors import InputError, PcbenchError
from pcbench.io import las, ply, write_cloud
from pcbench.io.las_records import LasFilters
from pcbench.io.pieces import las_pieces
from pcbench.io.source import Source


def mesh_bytes():
    faces = ("face", ["list uchar int vertex_indices"], [((0, 1, 2),)])
    return ply_bytes.ply(
        "binary_little_endian", ("vertex", ply_bytes.XYZ, [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]), faces
    )


@pytest.fixture
def opens(monkeypatch):
    """Number of times that each file is opened, by name; headers that are read are counted as `NAME header`."""
    counts = Counter()

    def counted_open(file, *args, open=io.open, **options):
        if not isinstance(file, int):  # a descriptor
            counts[Path(file).name] += 1
        return open(file, *args, **options)

    def counted_header(file, *args, read_header, **options):
        counts[f"{Path(file.name).name} header"] += 1
        return read_header(file, *args, **options)

    monkeypatch.setattr(io, "open", counted_open)  # of `Path.open`
    for user in (las, las_pieces, ply):
        monkeypatch.setattr(user, "read_header", partial(counted_header, read_header=user.read_header))
    return counts


def test_the_header_of_each_file_is_read_once(tmp_path, opens):
    (tmp_path / "a.las").write_bytes(las_bytes.las(1, 5))
    (tmp_path / "b.ply").write_bytes(mesh_bytes())
    write_cloud(tmp_path / "c.ply", np.eye(3))
    (tmp_path / "d.xyz").write_text("1 2 3\n4 5 6\n")
    looks = {"b.ply": 1, "b.ply header": 1, "c.ply": 1, "c.ply header": 1}  # whether they hold a mesh
    reads = {"a.las": 1, "a.las header": 1, "b.ply": 1, "c.ply": 1, "d.xyz": 1}
    for in_pieces in (False, True):
        opens.clear()
        for name in ("a.las", "b.ply", "c.ply", "d.xyz"):
            source = Source.open(tmp_path / name)
            assert opens[name] == 0
            assert source.kind == ("mesh" if name == "b.ply" else "cloud")
            if not in_pieces:
                source.read(pytest.fail)
            elif source.kind == "cloud":
                source.pieces()
        assert opens == Counter(looks) + Counter(reads) - Counter({"b.ply": in_pieces})


def test_the_file_is_not_another_one_when_it_is_read(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(mesh_bytes())
    source = Source.open(path)
    write_cloud(path, np.eye(3))
    with check_error(PcbenchError):
        source.read_with_digest(pytest.fail)


def test_files_that_no_output_may_replace(tmp_path):
    folder = tmp_path / "tiles"
    folder.mkdir()
    for name in ("2.las", "10.las"):
        (folder / name).write_bytes(las_bytes.las(1, 5))
    tiles = folder / "2.las", folder / "10.las"
    assert Source.open(folder).files == (folder, *tiles)
    assert Source.open(folder / "*.las").files == tiles
    assert Source.open(folder).nbytes == sum(tile.stat().st_size for tile in tiles)
    (tmp_path / "model").mkdir()
    (tmp_path / "model/points3D.txt").write_text("1 0.5 1.5 2.5 9 8 7 0.1 1 2\n")
    assert Source.open(tmp_path / "model").files == (tmp_path / "model", tmp_path / "model/points3D.txt")


def test_filters_apply_where_all_files_have_them(tmp_path):
    (tmp_path / "a.las").write_bytes(las_bytes.las(1, 5))
    write_cloud(tmp_path / "b.ply", np.eye(3))
    filters = LasFilters(classes=(2,))
    assert Source.open(tmp_path / "a.las").filtered(filters).filters == filters
    for path in (tmp_path / "b.ply", tmp_path):
        assert len(Source.open(path).filtered(filters).read(lambda _: None)) >= 3
        with pytest.raises(InputError, match="to filter by classes"):
            Source.open(path, filters).read(lambda _: None)
