"""Choice of the matcher, and COLMAP's maps, which a fake child process writes on machines without a GPU."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import textured_corner as corner
from exact_maps import corner_map
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.errors import ReconstructionError
from pcbench.io.colmap_model import read_colmap_cameras
from pcbench.scenes import read_scene
from reconstructors.mvs import backend
from reconstructors.mvs.backend import choose_backend, colmap_problem
from reconstructors.mvs.maps import read_map, write_raster
from reconstructors.mvs.mvs import DenseMvs

pycolmap = import_or_skip("pycolmap")

K = corner.standard_intrinsics(240, 180)


def fake_run(code, last_error_line=""):
    return lambda *_, **__: SimpleNamespace(code=code, last_error_line=last_error_line)


@pytest.mark.skipif(pycolmap.has_cuda, reason="this pycolmap has CUDA")
def test_bundled_matcher_runs_without_cuda():
    check_text(colmap_problem())
    assert choose_backend("auto") == ("bundled", colmap_problem())
    with check_error():
        choose_backend("colmap")


def test_crashing_probe_means_no_gpu(monkeypatch):
    monkeypatch.setattr(backend, "run_module", fake_run(-6))
    assert "-6" in colmap_problem()
    check_text(colmap_problem())
    assert choose_backend("auto")[0] == "bundled"
    assert choose_backend("bundled") == ("bundled", "as requested")
    monkeypatch.setattr(backend, "run_module", fake_run(0))
    name, reason = choose_backend("auto")
    assert name == "colmap"
    check_text(reason)
    assert choose_backend("colmap")[0] == "colmap"


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    return corner.write_scene(tmp_path_factory.mktemp("corner"), corner.cameras(4, K))


class FakeColmap:
    """Reads a workspace as COLMAP's dense stereo does and writes exact maps for the listed references without a map.

    It records the cameras of the workspace's model.
    """

    def __init__(self, true_cameras):
        self.true_cameras, self.matched_images, self.sources, self.cameras, self.points = true_cameras, [], {}, {}, 0

    def __call__(self, module, command, *arguments, **_):
        if command == "match":
            self.match(arguments[0])
        return SimpleNamespace(code=0, last_error_line="")

    def match(self, folder):
        from pathlib import Path

        folder = Path(folder)
        model = pycolmap.Reconstruction(folder / "sparse")
        self.points = model.num_points3D()
        self.cameras = {image.name: model.cameras[image.camera_id].params for image in model.images.values()}
        lines = (folder / "stereo/patch-match.cfg").read_text().splitlines()
        for name, sources in zip(lines[::2], lines[1::2], strict=True):
            self.sources[name] = sources.split(", ")
            assert (folder / "images" / name).resolve().is_file()
            path = folder / f"stereo/depth_maps/{name}.geometric.bin"
            if not path.is_file():
                depth_map = corner_map(self.true_cameras[int(name[:6]) - 1])
                depth = depth_map.depth.copy()
                depth[:5] = -1  # COLMAP writes this for filtered depths
                write_raster(path, depth)
                write_raster(folder / f"stereo/normal_maps/{name}.geometric.bin", depth_map.normal)
                self.matched_images.append(name)


@pytest.mark.long
def test_colmap_maps_are_used(photographs, tmp_path, monkeypatch):
    scene = read_scene(photographs)
    fake = FakeColmap(list(scene.cameras.values()))
    monkeypatch.setattr(backend, "run_module", fake)
    reconstruction = DenseMvs(backend="colmap").reconstruct(scene, tmp_path)
    assert np.median(corner.distances(reconstruction.cloud.points)) < 1e-5
    check_text(next(note for note in reconstruction.notes if note.startswith("backend colmap")))
    assert len(fake.matched_images) == 4
    assert all(name not in sources and len(sources) >= 2 for name, sources in fake.sources.items())
    assert fake.points > 30
    for parameters in fake.cameras.values():
        np.testing.assert_allclose(parameters, [K.fx, K.fy, K.cx - 0.5, K.cy - 0.5])
    # The model for other programs keeps COLMAP's convention of pixel centres.
    assert read_colmap_cameras(tmp_path / "maps")[0].intrinsics == K
    assert not read_map(tmp_path / "maps/001.png").known[:5].any()

    # Only the map that a killed run left incomplete is computed again.
    path = tmp_path / "colmap/stereo/depth_maps/000002.png.geometric.bin"
    path.write_bytes(path.read_bytes()[:1000])
    shutil.rmtree(tmp_path / "geometric")
    rerun = DenseMvs(backend="colmap").reconstruct(scene, tmp_path)
    assert fake.matched_images[4:] == ["000002.png"]
    np.testing.assert_array_equal(rerun.cloud.points, reconstruction.cloud.points)
    assert json.loads((tmp_path / "colmap/inputs.json").read_text())["seed"] == 0


def test_missing_colmap_maps_are_an_error(photographs, tmp_path, monkeypatch):
    def run(module, command, *_, **__):
        return SimpleNamespace(code=0 if command == "probe" else -6, last_error_line="out of memory")

    monkeypatch.setattr(backend, "run_module", run)
    with check_error(ReconstructionError):
        DenseMvs(backend="colmap").reconstruct(read_scene(photographs), tmp_path)
    monkeypatch.setattr(backend, "run_module", fake_run(0))
    with check_error(ReconstructionError):
        DenseMvs(backend="colmap").reconstruct(read_scene(photographs), tmp_path)
