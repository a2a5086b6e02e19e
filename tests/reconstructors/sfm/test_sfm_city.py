"""Sparse structure from motion on the synthetic city, whose cameras and surface are known exactly."""

import re
from pathlib import Path

import numpy as np
import pytest
from optional import import_or_skip

from pcbench.geometry.cameras import Intrinsics
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.transform import fit_similarity
from pcbench.io.meshes import read_mesh
from pcbench.scenes import read_scene
from pcbench.scenes.synthetic.files import SceneSettings, write_scene
from pcbench.scenes.synthetic.plan import CitySettings
from reconstructors.sfm.alignment import camera_errors, transform_camera
from reconstructors.sfm.sfm import ColmapSfm

import_or_skip("pycolmap")


def make_city(folder: Path, settings: SceneSettings):
    write_scene(folder, settings)
    return read_scene(folder), MeshIndex(read_mesh(folder / "truth/mesh.ply"))


@pytest.mark.long
def test_a_small_city_is_reconstructed_to_a_pixel(renderer, tmp_path):
    intrinsics = Intrinsics(480, 360, 400.0, 400.0, 240.0, 180.0, (-0.05, 0.01, 0.0, 0.0))
    settings = SceneSettings(CitySettings(extent=100.0, seed=3), 12, intrinsics, "grid", points=1000)
    scene, surface = make_city(tmp_path / "city", settings)
    work = tmp_path / "work"
    work.mkdir()
    with_given_poses = ColmapSfm(upsample=False).reconstruct(scene, work)
    assert int(re.search(r"(\d+)% of the verified matches agree", " ".join(with_given_poses.notes))[1]) >= 98
    assert len(with_given_poses.cloud) > 1000
    # A pixel at the ground is the flying height over the focal length, 0.2 to 0.3 m here.
    height = scene.cameras["0001.png"].position[2]
    pixel = height / intrinsics.fx
    # Points are accurate to a third of a pixel; their depths are less so, as the base is a quarter of the height.
    assert np.median(surface.query(with_given_poses.cloud.points).distances) < 0.5 * pixel
    with_solved_poses = ColmapSfm(upsample=False, poses="solve", refine="none").reconstruct(scene, work)
    positions, angles = camera_errors(with_solved_poses.cameras, scene.cameras)
    assert len(positions) == 12
    assert positions.max() < pixel
    assert angles.max() < 0.2  # a tilt of 0.1 degrees and a step of a pixel look nearly the same from above
    assert np.median(surface.query(with_solved_poses.cloud.points).distances) < 0.6 * pixel
    # Vertical images do not fix the intrinsics (James & Robson 2014): a note reports it if they are solved for.
    warning = "all images look in the same direction within"
    assert warning not in " ".join(with_solved_poses.notes)
    with_solved_intrinsics = ColmapSfm(upsample=False, poses="solve").reconstruct(scene, work)
    assert warning in " ".join(with_solved_intrinsics.notes)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_all_images_of_a_city_register(renderer, tmp_path, seed):
    """The command of docs/howto/synthetic.md: all 40 images register, with and without known cameras."""
    settings = SceneSettings(CitySettings(seed=seed), points=1000)
    scene, surface = make_city(tmp_path / "city", settings)
    work = tmp_path / "work"
    work.mkdir()
    truth = scene.cameras
    for variant, poses, min_share in (
        (scene, "given", 0.98),
        (scene, "solve", None),
        (read_scene(tmp_path / "city", cameras="none"), "solve", None),
    ):
        reconstruction = ColmapSfm(poses=poses).reconstruct(variant, work)
        fit = fit_similarity(*(np.array([c[n].position for n in truth]) for c in (reconstruction.cameras, truth)))
        positions, angles = camera_errors(
            {n: transform_camera(c, fit) for n, c in reconstruction.cameras.items()}, truth
        )
        assert len(positions) == 40
        # A pixel is 0.1 to 0.7 m on the ground.
        assert np.median(positions) < 0.2
        assert np.median(angles) < 0.05
        assert np.median(surface.query(fit.apply(reconstruction.cloud.points)).distances) < 0.3
        assert len(reconstruction.cloud) > 10_000
        if min_share is not None:
            agreement_percent = int(
                re.search(r"(\d+)% of the verified matches agree", " ".join(reconstruction.notes))[1]
            )
            assert agreement_percent >= 100 * min_share
