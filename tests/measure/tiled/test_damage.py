"""Comparisons in tiles that continue after a kill, in a workspace that was damaged or that somebody else has made."""

import os
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from partial_comparisons import skip_deformation
from tiled_clouds import with_stored_results
from tiled_pairs import Pair, noisy, surface
from tiled_runs import as_document

from pcbench.errors import PcbenchError
from pcbench.io import read_cloud, write_cloud
from pcbench.measure.tiled import runs

COLUMNS = ("points", "order", "normals", "rows", "spacings", "distance", "plane_distance")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A pair whose comparison has finished in the folder `work`, and its result."""
    rng = np.random.default_rng(0)
    points = surface(rng, 1500)
    pair = Pair(tmp_path_factory.mktemp("pair"), points, noisy(rng, points[::2]), crop="box:1,1,-9,9,9,9")
    with pytest.MonkeyPatch.context() as patch:
        with_stored_results(patch)
        skip_deformation(patch)
        return pair, as_document(pair.tiled())


@pytest.fixture
def killed(finished, tmp_path, monkeypatch):
    """The same pair with a copy of its workspace, whose last stages have no results: the run was killed there."""
    pair, expected = finished
    with_stored_results(monkeypatch)
    skip_deformation(monkeypatch)
    work = tmp_path / "work"
    shutil.copytree(pair.folder / "work", work)
    for late in work.glob("*/results/candidate-1-*"):
        shutil.rmtree(late)
    return pair, work, expected


def truncate(file):
    os.truncate(file, file.stat().st_size // 2)


def zero(file):
    """As after a power failure: the header is there, the values are not."""
    with file.open("r+b") as opened:
        opened.seek(128)
        opened.write(bytes(file.stat().st_size - 128))


def edit(file):
    values = np.load(file)
    np.save(file, values + values.dtype.type(1))


def flip(file):
    data = bytearray(file.read_bytes())
    data[-3] ^= 1
    file.write_bytes(data)


def swap(file):
    other = next(path for path in sorted(file.parent.glob("*.npy"), reverse=True) if path != file)
    content = file.read_bytes()
    file.write_bytes(other.read_bytes())
    other.write_bytes(content)


def delete(file):
    file.unlink()


@pytest.mark.parametrize("first", [0, pytest.param(3, marks=pytest.mark.long)])
def test_damaged_columns_are_computed_again(killed, first):
    pair, work, expected = killed
    columns = [sorted(work.rglob(f"*.{name}.npy")) for name in COLUMNS]
    assert all(columns)
    for number, files in enumerate(columns, first):
        damage = (truncate, zero, edit, flip, swap, delete)[number % 6]
        damage(files[len(files) // 2])
    assert as_document(pair.tiled(work)) == expected


def test_a_repeat_of_a_finished_run_checks_its_columns(killed):
    pair, work, expected = killed
    pair.tiled(work)
    for file in work.rglob("*.distance.npy"):
        edit(file)
    assert as_document(pair.tiled(work)) == expected


class Attack:
    def __reduce__(self):
        return os.mkdir, ("attacked",)


def test_a_workspace_of_somebody_else_runs_no_code(killed, tmp_path, monkeypatch):
    pair, work, expected = killed
    monkeypatch.chdir(tmp_path)
    for file in [path for path in work.rglob("*") if path.is_file()]:
        file.write_bytes(pickle.dumps(Attack()))
    assert as_document(pair.tiled(work)) == expected
    assert not (tmp_path / "attacked").exists()


def shift(path):
    """Move a cloud by a metre, and restore the time of its file."""
    before = path.stat()
    cloud = read_cloud(path)
    write_cloud(path, replace(cloud, points=cloud.points + [0, 0, 1]))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size


@pytest.mark.long
@pytest.mark.parametrize("name", ["ref", "a"])
def test_an_input_with_another_content_and_the_same_time_starts_again(killed, tmp_path, name):
    pair, work, expected = killed
    moved = Pair(tmp_path / "moved", np.eye(3), np.eye(3))
    moved.settings, original = pair.settings, {key: path.read_bytes() for key, path in pair.paths.items()}
    moved.paths = pair.paths
    try:
        shift(pair.paths[name])
        found = moved.tiled(work)
        assert as_document(found) == as_document(moved.tiled(tmp_path / "new"))
        assert as_document(found) != expected
    finally:
        pair.paths[name].write_bytes(original[name])
    assert as_document(pair.tiled(work)) == expected


def test_an_input_that_changes_while_it_is_read(finished, tmp_path, monkeypatch):
    pair, expected = finished
    with_stored_results(monkeypatch)
    skip_deformation(monkeypatch)
    path = pair.paths["a"]
    original, read_piece = path.read_bytes(), runs.read_piece

    def changing(cloud, piece):
        if piece.file == path:
            shift(path)
        return read_piece(cloud, piece)

    with monkeypatch.context() as patch, pytest.raises(PcbenchError, match="changed while it was read"):
        patch.setattr(runs, "read_piece", changing)
        pair.tiled(tmp_path / "work")
    path.write_bytes(original)
    assert as_document(pair.tiled(tmp_path / "work")) == expected
