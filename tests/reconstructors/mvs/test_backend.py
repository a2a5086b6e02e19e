"""Which matcher runs; and COLMAP's, whose child stands in for a GPU where there is none."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import textured_corner as corner
from exact_maps import corner_map
from optional import import_or_skip
from PIL import Image
from wording import refused, said

from pcbench.errors import ReconstructionError
from pcbench.io.colmap_model import read_colmap_cameras, write_colmap_model
from pcbench.scenes import read_scene
from reconstructors.mvs import backend
from reconstructors.mvs.backend import choose_backend, why_no_colmap
from reconstructors.mvs.maps import read_map, write_raster
from reconstructors.mvs.mvs import DenseMvs

pycolmap = import_or_skip("pycolmap")


def ended(code, words=""):
    return lambda *_, **__: SimpleNamespace(code=code, last_words=words)


@pytest.mark.skipif(pycolmap.has_cuda, reason="this pycolmap has CUDA")
def test_without_cuda_the_bundled_one_runs():
    said(why_no_colmap())
    assert choose_backend("auto") == ("bundled", why_no_colmap())
    with refused():
        choose_backend("colmap")


def test_a_child_that_dies_is_no_gpu(monkeypatch):
    monkeypatch.setattr(backend, "run_module", ended(-6))
    assert "-6" in why_no_colmap()
    said(why_no_colmap())
    assert choose_backend("auto")[0] == "bundled"
    assert choose_backend("bundled") == ("bundled", "asked for")
    monkeypatch.setattr(backend, "run_module", ended(0))
    name, why = choose_backend("auto")
    assert name == "colmap"
    said(why)
    assert choose_backend("colmap")[0] == "colmap"


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corner")
    (folder / "images").mkdir()
    cameras = corner.cameras(4, corner.standard_intrinsics(320, 240))
    for camera in cameras:
        Image.fromarray(corner.photograph(camera)).save(folder / "images" / camera.name)
    write_colmap_model(folder / "sparse", cameras)
    return folder


class FakeColmap:
    """Reads a workspace as COLMAP's dense stereo does and writes exact maps for the references of its list that have
    none yet; what its model says of the cameras is kept.
    """

    def __init__(self, true):
        self.true, self.made, self.sources, self.cameras, self.points = true, [], {}, {}, 0

    def __call__(self, module, command, *arguments, **_):
        if command == "match":
            self.match(arguments[0])
        return SimpleNamespace(code=0, last_words="")

    def match(self, folder):
        from pathlib import Path

        folder = Path(folder)
        model = pycolmap.Reconstruction(folder / "sparse")
        self.points = model.num_points3D()
        self.cameras = {image.name: model.cameras[image.camera_id].params for image in model.images.values()}
        lines = (folder / "stereo/patch-match.cfg").read_text().splitlines()
        for short, sources in zip(lines[::2], lines[1::2], strict=True):
            self.sources[short] = sources.split(", ")
            assert (folder / "images" / short).resolve().is_file()
            out = folder / f"stereo/depth_maps/{short}.geometric.bin"
            if not out.is_file():
                made = corner_map(self.true[int(short[:6]) - 1])
                depth = made.depth.copy()
                depth[:5] = -1  # COLMAP has these where it filters
                write_raster(out, depth)
                write_raster(folder / f"stereo/normal_maps/{short}.geometric.bin", made.normal)
                self.made.append(short)


def test_maps_of_colmap_are_taken(photographs, tmp_path, monkeypatch):
    scene = read_scene(photographs)
    fake = FakeColmap(list(scene.cameras.values()))
    monkeypatch.setattr(backend, "run_module", fake)
    made = DenseMvs(backend="colmap").reconstruct(scene, tmp_path)
    assert np.median(corner.distances(made.cloud.points)) < 1e-5
    said(next(note for note in made.notes if note.startswith("backend colmap")))
    assert len(fake.made) == 4
    assert all(short not in sources and len(sources) >= 2 for short, sources in fake.sources.items())
    assert fake.points > 100
    k = corner.standard_intrinsics(320, 240)
    for parameters in fake.cameras.values():
        np.testing.assert_allclose(parameters, [k.fx, k.fy, k.cx - 0.5, k.cy - 0.5])
    # What others read keeps its own convention.
    assert read_colmap_cameras(tmp_path / "maps")[0].intrinsics == k
    assert not read_map(tmp_path / "maps/001.png").known[:5].any()

    # A killed run left a map half-written: it alone is made again.
    path = tmp_path / "colmap/stereo/depth_maps/000002.png.geometric.bin"
    path.write_bytes(path.read_bytes()[:1000])
    shutil.rmtree(tmp_path / "geometric")
    again = DenseMvs(backend="colmap").reconstruct(scene, tmp_path)
    assert fake.made[4:] == ["000002.png"]
    np.testing.assert_array_equal(again.cloud.points, made.cloud.points)
    assert json.loads((tmp_path / "colmap/inputs.json").read_text())["seed"] == 0


def test_why_there_are_no_maps_of_colmap(photographs, tmp_path, monkeypatch):
    def run(module, command, *_, **__):
        return SimpleNamespace(code=0 if command == "probe" else -6, last_words="out of memory")

    monkeypatch.setattr(backend, "run_module", run)
    with refused(ReconstructionError):
        DenseMvs(backend="colmap").reconstruct(read_scene(photographs), tmp_path)
    monkeypatch.setattr(backend, "run_module", ended(0))
    with refused(ReconstructionError):
        DenseMvs(backend="colmap").reconstruct(read_scene(photographs), tmp_path)
