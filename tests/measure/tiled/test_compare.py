"""Comparisons in tiles against the same comparison in memory, and against themselves with other tiles."""

import json
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from partial_comparisons import skip_changes, skip_deformation
from tiled_clouds import in_this_process
from tiled_pairs import Pair, check_equal, noisy, surface
from tiled_runs import as_document
from wording import check_error

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity
from pcbench.io.map_tiles import write_overview
from pcbench.measure.deviation import Spread
from pcbench.measure.tiled.settings import TilingSettings


def holes(rng):
    points = surface(rng, 900)
    return points[np.hypot(*(points[:, :2] - 5).T) > 2], noisy(rng, surface(rng, 700))


def outliers(rng):
    points = surface(rng, 900)
    far = rng.normal(size=(40, 3)) * 1000
    return np.concatenate([points, far[:20]]), np.concatenate([[[1e6, -2e6, 5.0]], noisy(rng, points[::3]), far[20:]])


def duplicates(rng):
    points = np.round(surface(rng, 2000), 1)
    return np.concatenate([points, points[:300], np.tile(points[:1], (30, 1))]), np.round(
        noisy(rng, points[::2], 0.1), 1
    )


def density(rng):
    dense, sparse = surface(rng, 1500, 0.4), surface(rng, 600)
    return np.concatenate([dense, sparse]), noisy(rng, np.concatenate([sparse[::2], dense[::5]]))


def sparse_reference(rng):
    return surface(rng, 40), noisy(rng, surface(rng, 2000))


def sparse_candidate(rng):
    return surface(rng, 2000), noisy(rng, surface(rng, 4))


def one_candidate_point(rng):
    return surface(rng, 2000), [[5.0, 5.0, 0.3]]


def one_point_each(rng):
    return surface(rng, 1), surface(rng, 1)


def one_reference_point(rng):
    return surface(rng, 1), surface(rng, 50)


def two_reference_points(rng):
    return surface(rng, 2), noisy(rng, surface(rng, 50))


def two_given_normals(rng):
    return Cloud(surface(rng, 2), normals=[[0.0, 0.0, 2.0], [0.6, 0.0, -0.8]]), surface(rng, 2)


def one_given_normal(rng):
    return Cloud(surface(rng, 2), normals=[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]), surface(rng, 5)


def two_equal_points(rng):
    return np.repeat(surface(rng, 1), 2, axis=0), surface(rng, 5)


def few_points(rng):
    return surface(rng, 12), noisy(rng, surface(rng, 15))


def equal_points(rng):
    return np.tile([[1.0, 2.0, 3.0]], (300, 1)), np.tile([[1.0, 2.0, 3.0]], (200, 1))


def utm(rng):
    points = surface(rng, 900) + [500_000, 5_000_000, 100]
    return points, noisy(rng, points[::2])


def given_normals(rng):
    points = surface(rng, 900)
    normals = rng.normal(size=points.shape)
    normals[::7] = 0
    return Cloud(points, normals=normals), noisy(rng, points[::2])


def strips(rng):
    """Parts with nothing between them: most tiles of the curve are empty."""
    points = surface(rng, 900)
    points[:, 0] = np.round(points[:, 0] / 3) * 300 + points[:, 0] % 0.1
    return points, noisy(rng, points[::2])


FEWER_THAN_A_PLANE = (
    one_point_each, one_reference_point, two_reference_points, two_given_normals, one_given_normal, two_equal_points,
)  # fmt: skip
KINDS = (
    *FEWER_THAN_A_PLANE, holes, outliers, duplicates, density, sparse_reference, sparse_candidate, one_candidate_point,
    few_points, equal_points, utm, given_normals, strips,
)  # fmt: skip


# The tests of `test_assessment` compare the test for deformation too; here are kinds in which it is undecided.
WITH_DEFORMATION = (*FEWER_THAN_A_PLANE, sparse_reference, one_candidate_point, few_points, equal_points)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_numbers_are_those_in_memory(tmp_path, monkeypatch, kind):
    in_this_process(monkeypatch)
    if kind not in WITH_DEFORMATION:
        skip_deformation(monkeypatch)
    pair = Pair(tmp_path / "pair", *kind(np.random.default_rng(0)))
    expected = pair.memory()
    check_equal(pair.tiled(maps=tmp_path / "maps"), expected)
    check_rasters(tmp_path / "maps", expected)


def check_rasters(folder, memory):
    """Check that the GeoTIFF files of a comparison in tiles are those of the one in memory, in all bytes."""
    own = folder.with_name("rasters")
    own.mkdir()
    for candidate in memory:
        for kind, map_ in {"distance": candidate.deviation, "completeness": candidate.completeness}.items():
            file = write_overview(own, candidate.name, map_.overview, kind=kind)
            assert file.read_bytes() == (folder / file.name).read_bytes()  # sums are rounded once


HAS_KISS = find_spec("kiss_matcher") is not None
CROPS = {
    "box": "box:2,2,-5,7,6,9",
    "sphere": "sphere:5,5,0.5,3",
    "polygon": "polygon",
    "reference": "reference",
    "corner": "box:0,0,-5,0.9,0.9,5",  # leaves most tiles without a point
}
CASES = [
    *({"crop": crop, "step": 0.3 if name == "corner" else 0.0} for name, crop in CROPS.items()),
    {"thresholds": (0.05, 0.3), "seed": 3, "two": True},
    {"deformation": False, "two": True},
    {"register": "icp"},
    {"register": "similarity"},
    {"register": "points"},
    pytest.param(
        {"register": "global"}, marks=[pytest.mark.long, pytest.mark.skipif(not HAS_KISS, reason="needs kiss_matcher")]
    ),
    {"register": "icp", "initial": Similarity(np.eye(3), np.array([0.2, 0.1, 0.0]), 1.0)},
]


def moved(points):
    """Points turned by a degree and shifted."""
    angle = np.deg2rad(1)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return Similarity(turn, np.array([0.1, -0.1, 0.02]), 1.0).apply(points)


def pair_of(folder, count=700, two=False, step=0.0, **settings):
    """Return a pair, with coordinates that are multiples of `step`."""
    rng = np.random.default_rng(0)
    points = surface(rng, count)
    a, b = noisy(rng, points[::2]), noisy(rng, surface(rng, count // 3))
    if settings.get("register", "none") != "none":
        a, b = moved(a), moved(b)
    if step:
        points, a, b = (np.round(rows / step) * step for rows in (points, a, b))
    return Pair(folder, points, *((a, b) if two else (a,)), **settings)


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(f"{key}-{str(case[key])[:12]}" for key in case))
def test_settings_have_the_same_effect_as_in_memory(tmp_path, monkeypatch, case):
    in_this_process(monkeypatch)
    if "two" not in case:  # which has a seed for the test for deformation too
        skip_deformation(monkeypatch)
        skip_changes(monkeypatch)
    if case.get("crop") == "polygon":
        file = tmp_path / "polygon.json"
        ring = [[1, 1], [8, 2], [6, 7], [2, 9], [1, 1]]
        file.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
        case = case | {"crop": f"polygon:{file}"}
    if case.get("register") == "points":
        places = surface(np.random.default_rng(1), 6)
        rows = np.hstack([np.arange(6)[:, None], moved(places), places])
        np.savetxt(tmp_path / "points.txt", rows, fmt=["p%d", *6 * ["%.6f"]])
        case = {"register": f"points:{tmp_path / 'points.txt'}"}
    pair = pair_of(tmp_path / "pair", **case)
    expected, maps = pair.memory(), tmp_path / "maps" if "crop" in case else None
    check_equal(pair.tiled(maps=maps, tile_points=300), expected)
    if maps is not None:
        check_rasters(maps, expected)


@pytest.mark.long
def test_no_bit_depends_on_the_tiles_or_the_order_of_arrival(tmp_path, monkeypatch):
    pair = pair_of(tmp_path / "pair", two=True, crop="sphere:5,5,0.5,4")
    found = []
    for seed, size in enumerate((100, 250, 500, None)):  # of clouds in three pieces
        in_this_process(monkeypatch, seed)
        monkeypatch.setattr(TilingSettings, "chosen_piece_points", 700)  # of three pieces
        found.append(pair.tiled(f"work-{size}", tmp_path / f"maps-{size}", tile_points=size))
    assert len({comparison.tiling.tiles for comparison in found}) == 4
    documents = [as_document(comparison) for comparison in found]
    assert all(one == documents[0] for one in documents[1:])
    overviews = [sorted((tmp_path / f"maps-{size}").glob("*.tif")) for size in (100, None)]
    assert len(overviews[0]) == 4
    assert [file.read_bytes() for file in overviews[0]] == [file.read_bytes() for file in overviews[1]]


@pytest.mark.usefixtures("without_deformation", "without_changes")
def test_a_maximum_distance_caps_larger_distances_and_counts_them(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    pair, limit = pair_of(tmp_path / "pair", thresholds=(0.05, 0.12)), 0.12
    exact = pair.memory()
    capped = pair.tiled(max_distance=limit)
    shares = []
    for a, b in zip(capped, exact, strict=True):
        for way, found, expected in (
            ("candidate_to_reference", a.deviation, b.deviation),
            ("reference_to_candidate", a.completeness, b.completeness),
        ):
            distances, true = found.scalars["distance"], expected.scalars["distance"]
            np.testing.assert_array_equal(distances, np.minimum(true, limit))
            assert a.censored[way] == np.mean(true > limit)
            shares.append(a.censored[way])
        assert ("plane_distance" in a.deviation.scalars) == (a.censored["candidate_to_reference"] == 0)
        for score, full in zip(a.metrics.fscores, b.metrics.fscores, strict=True):
            assert (score.precision.value, score.recall.value) == (full.precision.value, full.recall.value)
    assert min(shares) >= 0 and max(shares) > 0.2
    none_beyond = pair.tiled("work-2", max_distance=1e6)
    assert set(none_beyond["a"].censored.values()) == {0.0}
    assert as_document(replace_censored(none_beyond)) == as_document(pair.tiled("work-3"))


def part_lifted(rng):
    """A candidate that lies 3 m above the reference in one half."""
    points = surface(rng, 1500)
    lifted = points[::2].copy()
    lifted[lifted[:, 0] > 5, 2] += 3
    return points, lifted


@pytest.mark.usefixtures("without_deformation", "without_changes")
@pytest.mark.parametrize("tile_points", [100])
@pytest.mark.parametrize(("crop", "share"), [("none", 0.5), ("box:6,0,-5,10,10,9", 1.0)])
def test_tiles_wholly_beyond_the_maximum_distance(tmp_path, monkeypatch, tile_points, crop, share):
    in_this_process(monkeypatch)
    pair = Pair(tmp_path / "pair", *part_lifted(np.random.default_rng(0)), crop=crop, thresholds=(0.2, 1.0))
    exact, found = (comparison["a"] for comparison in (pair.memory(), pair.tiled(max_distance=1.0)))
    for way, censored in found.censored.items():
        assert censored == pytest.approx(share, abs=0.1)
        metrics = found.metrics
        assert metrics.d2_mse[way].value is metrics.d2_mse[way].interval is None
        spread = metrics.spreads["distance"][way]
        assert metrics.spreads["plane_distance"][way] == Spread() and spread.nmad is spread.std is None
        assert 0 < metrics.mean_distance[way].value < exact.metrics.mean_distance[way].value
        assert spread.percentiles["p99"] == metrics.hausdorff[way].largest == 1.0
    assert metrics.d2_mse.symmetric_max.value is None
    assert metrics.presets["gao2025"].d2_mse is None
    assert [score.fscore.value for score in metrics.fscores] == [s.fscore.value for s in exact.metrics.fscores]


@pytest.mark.usefixtures("without_deformation", "without_changes")
def test_one_direction_without_distances_beyond_the_maximum_keeps_its_d2(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    points = surface(np.random.default_rng(0), 1500)
    pair = Pair(tmp_path / "pair", points, points[points[:, 0] < 5], thresholds=(0.2,))
    exact, found = (comparison["a"].metrics.d2_mse for comparison in (pair.memory(), pair.tiled(max_distance=1.0)))
    assert found.accuracy == exact.accuracy
    assert (found.completeness.value, found.symmetric_max.value) == (None, None)


def test_thresholds_beyond_the_maximum_distance_are_refused(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    with check_error(InputError):
        pair_of(tmp_path / "pair", thresholds=(0.1, 0.5)).tiled(max_distance=0.3)


def replace_censored(comparison):
    return replace(comparison, candidates=tuple(replace(candidate, censored={}) for candidate in comparison))


@pytest.mark.usefixtures("without_deformation", "without_changes")
def test_a_changed_polygon_or_matrix_is_not_mistaken_for_the_old_one(tmp_path, monkeypatch):
    """The same command in the same workspace, after a file that the settings name was edited."""
    in_this_process(monkeypatch)
    matrix, polygon = tmp_path / "matrix.txt", tmp_path / "polygon.json"
    pair = pair_of(tmp_path / "pair", crop=f"polygon:{polygon}", register=f"matrix:{matrix}")
    for shift, corner in ((0.1, 8), (0.2, 8), (0.2, 6)):
        pose = np.eye(4)
        pose[0, 3] = shift
        np.savetxt(matrix, pose)
        ring = [[1, 1], [corner, 2], [6, 7], [2, 9], [1, 1]]
        polygon.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
        check_equal(pair.tiled(), pair.memory())


@pytest.mark.usefixtures("without_deformation", "without_changes")
def test_another_folder_for_the_maps_gets_them_all(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    pair = pair_of(tmp_path / "pair")
    pair.tiled()
    names = []
    for name in ("one", "two"):
        pair.tiled(maps=tmp_path / name)
        names.append(sorted(str(path.relative_to(tmp_path / name)) for path in (tmp_path / name).rglob("*.*")))
    assert names[0] == names[1] and any(name.endswith(".tif") for name in names[0])


def test_a_region_without_points_is_refused(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    pair = pair_of(tmp_path / "pair", crop="box:50,50,50,60,60,60")
    with pytest.raises(InputError, match=r"the crop 'box:50,50,50,60,60,60' leaves none of the reference's 700 points"):
        pair.tiled()


@pytest.mark.usefixtures("without_deformation", "without_changes")
def test_points_that_are_not_finite_are_left_out_as_in_memory(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    monkeypatch.setattr(TilingSettings, "chosen_piece_points", 400)
    rng = np.random.default_rng(0)
    points = surface(rng, 2000)
    pair = Pair(tmp_path / "pair", points, noisy(rng, points[::2]))
    for name, rows in (("ref", slice(400, 800)), ("a", slice(3, None, 50))):  # a piece without a point, and some points
        data = pair.paths[name].read_bytes()
        start = data.index(b"end_header\n") + 11
        values = np.frombuffer(data[start:], "<f8").reshape(-1, 3).copy()
        values[rows] = np.nan
        pair.paths[name].write_bytes(data[:start] + values.tobytes())
    tiled = pair.tiled()
    check_equal(tiled, pair.memory(), with_warnings=False)
    assert [w.code for w in tiled.reference.warnings] == [w.code for w in tiled["a"].warnings] == ["reader"]
    assert "400 of 2000" in tiled.reference.warnings[0].text
