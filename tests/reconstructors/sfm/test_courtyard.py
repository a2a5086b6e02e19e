"""Repeated facades: a courtyard whose wrong solution is only detected by contradicting pairs."""

import re

import courtyard
import numpy as np
import pytest
from optional import import_or_skip
from PIL import Image

from pcbench.geometry.transform import robust_similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.scenes import read_scene
from reconstructors.sfm.alignment import camera_errors, transform_camera
from reconstructors.sfm.sfm import ColmapSfm

import_or_skip("pycolmap")


def photograph_courtyard(folder, *, own, inwards):
    (folder / "images").mkdir(parents=True)
    (folder / "work").mkdir()
    cameras = courtyard.cameras(30, courtyard.standard_intrinsics(), inwards)
    for camera in cameras:
        Image.fromarray(courtyard.photograph(camera, own)).save(folder / "images" / camera.name)
    write_colmap_model(folder / "sparse", cameras)
    return read_scene(folder)


def errors_after_alignment(reconstruction, truth):
    names = sorted(reconstruction.cameras)
    fit = robust_similarity(
        *(np.array([cameras[name].position for name in names]) for cameras in (reconstruction.cameras, truth))
    )
    return camera_errors(
        {name: transform_camera(camera, fit) for name, camera in reconstruction.cameras.items()}, truth
    )


@pytest.mark.slow
@pytest.mark.parametrize("mapping", ["incremental", "global"])
def test_a_wrong_solution_is_replaced_by_one_without_weak_pairs(tmp_path, mapping):
    """Both mappers fold this courtyard (2 to 4 m, 100 to 170 degrees), misled by weak pairs of different bays."""
    truth = photograph_courtyard(tmp_path, own=0.25, inwards=False).cameras
    scene = read_scene(tmp_path, cameras="none")
    reconstruction = ColmapSfm(mapping=mapping, upsample=False, features=4000).reconstruct(scene, tmp_path / "work")
    positions, angles = errors_after_alignment(reconstruction, truth)
    assert len(positions) == 30
    assert positions.max() < 0.05  # a pixel is 0.02 to 0.03 m
    assert angles.max() < 0.5
    notes = " ".join(reconstruction.notes)
    assert f"{mapping} mapping registers" in notes
    assert "kept: incremental mapping from pairs of at least 100 matches" in notes
    assert "warning: " not in notes


@pytest.mark.slow
def test_a_courtyard_that_cannot_be_solved_is_not_georeferenced(tmp_path):
    """If the bays are nearly identical, all solutions are wrong, and reported as such in spite of good GPS."""
    truth = photograph_courtyard(tmp_path, own=0.1, inwards=True).cameras
    gps = [f"{name} {' '.join(map(str, camera.position))}\n" for name, camera in truth.items()]
    (tmp_path / "gps.txt").write_text("".join(gps))
    scene = read_scene(tmp_path, cameras="none")
    reconstruction = ColmapSfm(mapping="global", upsample=False, features=4000).reconstruct(scene, tmp_path / "work")
    assert errors_after_alignment(reconstruction, truth)[0].max() > 1
    assert (reconstruction.gauge, reconstruction.cloud.unit) == ("arbitrary", None)
    notes = " ".join(reconstruction.notes)
    assert "warning: " in notes
    assert "contradict the solved cameras: places that look alike were confused" in notes
    assert "not aligned" in notes
    assert (tmp_path / "work/pairs.csv").is_file()


@pytest.mark.slow
def test_a_weakly_constrained_camera_is_named(tmp_path):
    """A camera sees one wall, and 40 % of its pairs are wrong: incremental mapping is off by 0.26 m there."""
    scene = photograph_courtyard(tmp_path, own=0.3, inwards=True)
    reconstruction = ColmapSfm(poses="solve", refine="none", upsample=False, features=4000).reconstruct(
        scene, tmp_path / "work"
    )
    positions, _ = camera_errors(reconstruction.cameras, scene.cameras)
    worst_name = sorted(reconstruction.cameras)[int(np.argmax(positions))]
    (note,) = [note for note in reconstruction.notes if "little fixes" in note]
    assert f"puts {worst_name} 0." in note
    match = next(
        re.search(r"and (\d+)% of the \d+ pairs", note)
        for note in reconstruction.notes
        if "verified matches agree" in note
    )
    assert int(match[1]) < 75
