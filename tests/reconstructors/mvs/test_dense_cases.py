"""Scoring of dense clouds and maps in benchmarks/mvs_city.py, on clouds and maps with known errors."""

from types import SimpleNamespace

import numpy as np
import pytest
from dense_cases import MAX_FLAT_STD, WINDOW, City, deviations, read_city, recall_by_cause, score_cloud, score_maps
from exact_maps import mesh_map
from optional import import_or_skip
from PIL import Image
from repository import ROOT

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.io.colmap_model import write_colmap_model
from reconstructors.mvs.maps import DepthMap, write_map

# A square of ground of 10 m; half of its visible part has texture.
GROUND = MeshIndex(Mesh([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]], [[0, 1, 2], [0, 2, 3]]))
SURFACE_POINTS = np.array([[x, y, 0.0] for x in np.arange(0.05, 10, 0.1) for y in np.arange(0.05, 10, 0.1)])
VIEW_COUNTS = np.where(SURFACE_POINTS[:, 1] < 9, 9, 3)
CITY = City(None, None, GROUND, SURFACE_POINTS, VIEW_COUNTS, 8 * SURFACE_POINTS[:, 1], SURFACE_POINTS[:, 0] < 5, 0.101)


def test_noise_is_untextured_and_squares_are_textured():
    rng = np.random.default_rng(0)
    noise = np.clip(rng.normal(120, 1.5, (60, 80)), 0, 255).astype(np.uint8)
    squares = noise + np.uint8(20) * ((np.indices(noise.shape) // 4).sum(axis=0) % 2).astype(np.uint8)
    radius = WINDOW // 2
    window_std = deviations(squares)
    window = squares[20 - radius : 20 + radius + 1, 30 - radius : 30 + radius + 1]
    assert window_std[20, 30] == pytest.approx(window.std())
    assert (window_std > MAX_FLAT_STD).all()
    assert (deviations(noise) < MAX_FLAT_STD).all()


def test_score_cloud():
    true_points = SURFACE_POINTS[SURFACE_POINTS[:, 1] < 8]
    near_points = true_points + [0, 0, 0.15]  # between one and two footprints
    outliers = true_points[: len(true_points) // 4] + [0, 0, 3.0]
    scores = score_cloud(CITY, np.concatenate([true_points, near_points, outliers]))
    assert scores.points == 2 * len(true_points) + len(true_points) // 4
    np.testing.assert_allclose(scores.precision, [1 / 2.25, 2 / 2.25, 2 / 2.25])
    assert scores.wrong == pytest.approx(0.25 / 2.25)
    # Four fifths of the ground, and beyond it up to the threshold.
    np.testing.assert_allclose(scores.recall, [0.81, 0.82, 0.85], atol=1e-9)
    np.testing.assert_allclose(scores.textured, scores.recall)
    assert scores.empty == pytest.approx(0.15)
    assert scores.plain_share == 0.5
    assert scores.accuracy == pytest.approx(0.15 / 0.101)
    # Rows 0.1 apart: the eight tenths with points are exact, and row n beyond them is n rows away.
    assert scores.completeness == pytest.approx(np.arange(1, 21).mean() * 0.1 * 0.2 / 0.101)
    textured_scores = score_cloud(CITY, true_points[true_points[:, 0] < 5])
    assert textured_scores.textured[0] == pytest.approx(0.81)
    assert textured_scores.plain[0] < 0.02


def test_missed_surface_is_classified():
    y = SURFACE_POINTS[:, 1]
    city = CITY._replace(views=np.where(y < 9, np.where(y < 6, 9, 4), np.where(y < 9.5, 2, 1)))
    recall = recall_by_cause(city, SURFACE_POINTS[y < 8])
    # At two footprints 82 of 100 rows are found; the angle is 8 degrees per unit, and the first half has texture.
    np.testing.assert_allclose(recall["one image"], [0.05, 0, 5 / 18])
    np.testing.assert_allclose(recall["two images, above 75 deg"], [0.01, 0, 1 / 18])
    np.testing.assert_allclose(recall["two images"], [0.04, 0, 4 / 18])
    np.testing.assert_allclose(recall["60 to 75 deg"], [0.15, 7 / 15, 8 / 18])
    np.testing.assert_allclose(recall["no texture"], [0.375, 1, 0])
    np.testing.assert_allclose(recall["three to five images"], [0.075, 1, 0])
    np.testing.assert_allclose(recall["none of these"], [0.3, 1, 0])
    assert recall["above 75 deg"].share == 0


def test_score_maps(tmp_path):
    """A strip of ground between two strips of sky, untextured in its left half."""
    k = Intrinsics(60, 40, 50.0, 50.0, 30.0, 20.0)
    cameras = [Camera(f"{n}.png", k, look_at([5 + n / 2, 5, 15], [5 + n / 2, 5, 0], up=[0, 1, 0])) for n in range(2)]
    rows, columns = np.indices((40, 60))
    angle = np.radians(5)
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    for camera in cameras:
        true_map = mesh_map(camera, GROUND)
        visible = true_map.depth > 0
        # The ground starts in row 3: seven rows are off by two pixels, four by ten. Beside it one row has depths.
        depth = true_map.depth * np.where(rows < 10, 1 + 2 / k.fx, np.where(rows < 14, 1 + 10 / k.fx, 1))
        depth = np.where(visible, depth, 15.0)
        depth_map = DepthMap(
            depth.astype(np.float32), (true_map.normal @ rotation).astype(np.float32), np.ones((40, 60), "f4")
        )
        for folder in (tmp_path / "maps" / camera.name, tmp_path / "views" / camera.name):
            folder.mkdir(parents=True)
        write_map(tmp_path / "maps" / camera.name, depth_map.where((rows < 30) & (visible | (rows == 20))))
        gray = np.where(columns < 30, 120, 120 + 40 * ((rows // 4 + columns // 4) % 2)).astype(np.uint8)
        Image.fromarray(gray).save(tmp_path / "views" / camera.name / "image.png")
    write_colmap_model(tmp_path / "maps", cameras)
    city = CITY._replace(index=GROUND)
    scores = score_maps(city, tmp_path)
    assert scores.known == pytest.approx(27 / 34, abs=0.02)
    np.testing.assert_allclose(scores.depth[:2], [0, 10], atol=1e-3)
    assert scores.depth[3] == np.inf
    assert scores.normal == pytest.approx(5, abs=0.01)
    assert scores.plain_known == pytest.approx(27 / 34, abs=0.02)
    assert scores.plain_wrong == pytest.approx(4 / 27, abs=0.03)
    assert scores.sky_known == pytest.approx(1 / 40, abs=0.01)


def test_seeds_are_summarised_by_median_and_range(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from mvs_city import SeedResult, describe_seeds, parse_seeds

    assert parse_seeds("5,101-103") == [5, 101, 102, 103]
    results = [SeedResult(*[0.5 + 0.01 * seed] * 7, 30.0 + seed, 2.0) for seed in (3, 1, 2)]
    lines = describe_seeds("city", results).splitlines()
    assert lines[0] == "city, 3 seeds:"
    assert lines[1].split() == ["precision", "0.520", "[0.510,", "0.530]"]
    assert lines[5].split() == ["wrong", "52.00%", "[51.00%,", "53.00%]"]
    assert lines[8].split() == ["cpu", "32.0", "[31.0,", "33.0]"]


def test_tables_are_merged_side_by_side(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from mvs_reference import side_by_side

    head = "a line\n\n      sparse\n   c→r   r→c\n"
    left = (
        head + "points measured       10      20\n  sampling floor     0.5       1\ndeformation         none\n\nreport"
    )
    right = head + "points measured       10      90\ndeformation         none\n  bend RMS           0.1\n"
    rows = [line.split("  ") for line in side_by_side(left, right).splitlines()]
    cells = [[word.strip() for word in line if word.strip()] for line in rows]
    assert cells == [
        ["points measured", "10", "20", "10", "90"],
        ["sampling floor", "0.5", "1"],
        ["deformation", "none", "none"],
        ["bend RMS", "0.1"],
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["city", "texture 0", "water", "moved"])
def test_city_depths_are_right(name, tmp_path, monkeypatch, renderer):
    """With texture, without texture, over water, and with moving objects that differ between photographs."""
    import_or_skip("pycolmap")
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from mvs_city import LAKES, LAKES_SEED, make_city, reconstruct, score_workspace

    seed = LAKES_SEED if name in LAKES else 11
    make_city(tmp_path / "city", name, SimpleNamespace(images=14, size="240x160", rig="oblique"), seed)
    reconstruct(tmp_path / "city", tmp_path)
    city = read_city(tmp_path / "city")
    cloud, maps = score_workspace(city, tmp_path), score_maps(city, tmp_path / "work" / "plugin")
    assert cloud.wrong < 0.02
    assert maps.plain_wrong < 0.02
    assert maps.sky_known < 0.01
    if name == "city":
        assert cloud.precision[1] > 0.9
        assert cloud.recall[1] > 0.6
        assert maps.normal < 10
