import pytest
import shapes
from benches import METHODS, RIG, TRUTH
from children_here import reconstructing_here
from optional import import_or_skip
from partial_comparisons import skip_changes, skip_deformation

from pcbench import Cloud, write_cloud
from pcbench.io.colmap_model import write_colmap_model
from pcbench.studies.bench.truth import read_truth


@pytest.fixture
def bench_folder(tmp_path, monkeypatch):
    """Current folder with photos/, truth.ply, made.ply and methods.py."""
    image = import_or_skip("PIL.Image")
    (tmp_path / "photos/images").mkdir(parents=True)
    for camera in RIG:
        image.new("RGB", (40, 30), (len(camera.name), 0, 0)).save(tmp_path / "photos/images" / camera.name)
    write_colmap_model(tmp_path / "photos/sparse", RIG)
    write_cloud(tmp_path / "truth.ply", TRUTH)
    write_cloud(tmp_path / "made.ply", Cloud(shapes.city(1000, seed=2)[0]))
    (tmp_path / "methods.py").write_text(METHODS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def truth(bench_folder):
    return read_truth(bench_folder / "truth.ply", None, {camera.name: camera for camera in RIG}, print)


@pytest.fixture
def in_process(monkeypatch):
    """Run reconstructors in this process and measure neither changes nor deformation, which saves a second each.

    Tests without this fixture show that separate processes protect the bench from crashes.
    """
    skip_changes(monkeypatch)
    skip_deformation(monkeypatch)

    with reconstructing_here():
        yield
