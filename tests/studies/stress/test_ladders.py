"""Ladders of perturbations: the first level changes nothing, and each level is what its unit says."""

import numpy as np
import pytest
from repository import ROOT
from wording import check_error

from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.neighbors import Index
from pcbench.studies.stress.ladders import LADDERS, displaced, selected
from pcbench.studies.stress.ladders.warps import split_observable_affine
from pcbench.studies.stress.scenes import SCENES, WOODED, degenerate_pair, extent_of, scene_pair
from pcbench.studies.stress.subjects import PAIR_SUBJECTS
from pcbench.studies.stress.surfaces import DEGENERATE

POINTS = 4000
HEAVY_TAILED = ("noise-heavy-tailed", "noise-mvs", "noise-splat")


@pytest.fixture(scope="module")
def city():
    return scene_pair("city", 0, POINTS)


@pytest.fixture(scope="module")
def wooded():
    return scene_pair(WOODED, 0, POINTS)


def climbed(pair, name, level, seed=0):
    ladder = LADDERS[name]
    second = ladder.second_levels[-1] if ladder.second_levels else None
    return ladder.apply(pair, level, second, np.random.default_rng(seed))


def rms(vectors):
    return np.sqrt(np.square(vectors).sum(axis=-1).mean())


@pytest.mark.parametrize("name", [*SCENES, WOODED])
def test_scene_is_two_independent_samples_of_its_surface(name):
    pair = scene_pair(name, 0, POINTS)
    assert len(pair.points) == len(pair.reference) // 2
    surface = MeshIndex(pair.surface)
    for cloud in (pair.reference, pair.points):
        # Near convex edges noise along the surface leaves it too; near concave ones the other side is closer.
        assert np.sqrt(np.square(surface.query(cloud).distances).mean()) == pytest.approx(pair.noise, rel=0.1)
    assert Index(pair.reference).query(pair.points).distances.min() > 0
    assert pair.extent == extent_of(pair.reference) and 0 < pair.spacing < 0.1 * pair.extent
    np.testing.assert_array_equal(scene_pair(name, 0, POINTS).points, pair.points)
    assert not np.array_equal(scene_pair(name, 1, POINTS).points, pair.points)


@pytest.mark.parametrize("name", DEGENERATE)
def test_normals_of_degenerate_surfaces_are_across_their_noise(name):
    pair = degenerate_pair(name, 0, POINTS)
    offsets = pair.points - MeshIndex(pair.surface).query(pair.points).closest
    along = np.einsum("ni,ni->n", offsets, pair.normals)
    assert np.median(np.abs(offsets - along[:, None] * pair.normals).max(axis=1)) < 1e-3 * pair.noise


@pytest.mark.parametrize("name", [name for name, ladder in LADDERS.items() if not ladder.sets_shape])
def test_every_ladder_starts_at_nothing_and_ends_far_from_it(name, city, wooded):
    ladder = LADDERS[name]
    city = wooded if ladder.needs_vegetation else city
    first, last = (climbed(city, name, level) for level in (ladder.levels[0], ladder.levels[-1]))
    for pair in (first, last):
        size = np.abs(pair.points).max()
        np.testing.assert_allclose(pair.T_true.apply(pair.candidate), pair.points, rtol=0, atol=1e-12 * max(size, 100))
        assert len(pair.points) >= 200 and pair.normals.shape == pair.points.shape
    np.testing.assert_allclose(first.points, city.points, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(first.reference, city.reference)
    moved = not np.allclose(last.T_true.matrix, city.T_true.matrix)
    moved |= len(last.reference) != len(city.reference)
    assert moved or len(last.points) != len(city.points) or rms(last.points - city.points) > 1e-3
    again = climbed(city, name, ladder.levels[-1])
    np.testing.assert_array_equal(again.candidate, last.candidate)


def test_start_is_turned_about_the_centroid(city):
    pair = displaced(city, 30.0, 7.0, np.random.default_rng(0))
    assert pair.T_true.motion_at(np.zeros(3)).angle_deg == pytest.approx(30.0)
    assert np.linalg.norm(pair.candidate.mean(axis=0) - city.points.mean(axis=0)) == pytest.approx(7.0)
    np.testing.assert_array_equal(pair.points, city.points)
    scaled = climbed(city, "scale", 2.0)
    assert scaled.T_true.scale == 2.0 and np.ptp(scaled.candidate) < np.ptp(city.points)


@pytest.mark.parametrize("name", [name for name in LADDERS if name.startswith("noise-") and name not in HEAVY_TAILED])
def test_noise_has_the_stated_size_in_spacings(name, city):
    noisy = climbed(city, name, 2.0)
    added = noisy.points - city.points
    if "ray" in name or "correlated" in name:  # in one direction per point
        assert rms(added) == pytest.approx(2 * city.spacing, rel=0.15)
    else:
        assert rms(added) == pytest.approx(2 * np.sqrt(3) * city.spacing, rel=0.05)
    expected = np.hypot(city.candidate_noise, rms(added) / np.sqrt(3))
    assert noisy.candidate_noise == pytest.approx(expected)
    assert noisy.tolerance >= city.tolerance


def test_heavy_tails_are_beyond_those_of_a_gaussian(city):
    added = np.abs(climbed(city, "noise-heavy-tailed", 1.0).points - city.points).ravel()
    assert np.quantile(added, 0.999) > 10 * np.median(added)


def test_correlated_noise_is_shared_by_neighbours(city):
    offsets = np.einsum("ni,ni->n", climbed(city, "noise-correlated", 1.0).points - city.points, city.normals)
    nearest = Index(city.points).nearest_other()
    along = np.abs(np.einsum("ni,ni->n", city.normals, city.normals[nearest.indices])) > 0.99
    sign = np.sign(np.einsum("ni,ni->n", city.normals, city.normals[nearest.indices]))
    assert np.corrcoef(offsets[along], (sign * offsets[nearest.indices])[along])[0, 1] > 0.8


def test_shares_of_parts_are_as_stated(city):
    assert len(climbed(city, "background", 60.0).points) == len(city.points) * 10 // 4
    assert len(climbed(city, "floaters", 20.0).points) == pytest.approx(len(city.points) * 1.25, abs=1)
    assert len(climbed(city, "density", 16.0).points) == pytest.approx(200, abs=80)
    assert len(climbed(city, "cutouts", 75.0).points) == pytest.approx(len(city.points) / 4, rel=0.05)
    assert len(climbed(city, "duplicates", 10.0).points) == 2 * len(city.points)
    hit = np.linalg.norm(climbed(city, "impulse", 20.0).points - city.points, axis=1) > 0
    assert hit.mean() == pytest.approx(0.2, abs=0.03)
    assert not (np.abs(climbed(city, "missing-walls", 100.0).normals[:, 2]) < 0.3).any()


@pytest.mark.parametrize("level", [25, 50, 75, 100])
def test_whole_plants_are_removed_first(level, wooded):
    def counts(pair):
        return np.bincount(pair.plants[pair.plants >= 0], minlength=wooded.plants.max() + 1)

    left, before = climbed(wooded, "missing-vegetation", level), counts(wooded)
    after, below = counts(left), counts(climbed(wooded, "missing-vegetation", level - 25))
    assert after.sum() == before.sum() - round(level / 100 * before.sum())
    assert ((after > 0) & (after < before)).sum() <= 1
    assert (after <= below).all()  # a higher level removes the same plants and further ones
    assert (left.plants < 0).sum() == (wooded.plants < 0).sum()


def test_trees_of_the_wooded_city_stand_on_its_ground(wooded):
    """Trees are where the city without them has none, at most 11 m high, and clear of each other."""
    bare = MeshIndex(scene_pair("city", 0, POINTS).surface)
    shown = wooded.plants >= 0
    assert 0.05 < shown.mean() < 0.2
    assert (bare.query(wooded.points[~shown]).distances < 6 * wooded.noise).all()
    assert bare.query(wooded.points[shown]).distances.max() > 2
    for plant in range(wooded.plants.max() + 1):
        crown = wooded.points[wooded.plants == plant]
        assert len(crown) == 0 or np.ptp(crown, axis=0).max() < 12


@pytest.mark.parametrize("level", [100, 60, 20])
def test_overlap_is_the_share_of_each_cloud_in_the_common_part(level, city):
    pair = climbed(city, "overlap", level, seed=3)
    # The cut is a plane, so the support of one cloud along its normal bounds the other.
    angle = np.random.default_rng(3).uniform(0, 2 * np.pi)
    across = np.array([np.cos(angle), np.sin(angle), 0.0])
    shared = pair.points @ across <= (pair.reference @ across).max()
    assert shared.mean() == pytest.approx(level / 100, abs=0.05)
    shared = pair.reference @ across >= (pair.points @ across).min()
    assert shared.mean() == pytest.approx(level / 100, abs=0.05)


def test_rounded_coordinates_are_multiples_of_the_step(city):
    step = 0.5 * city.spacing
    ratio = climbed(city, "quantised", 0.5).points / step
    np.testing.assert_allclose(ratio, np.round(ratio), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", [name for name in LADDERS if name.startswith("warp-")])
@pytest.mark.parametrize("scene", ["city", "object"])
def test_warps_have_the_stated_size_beyond_affine_motions(name, scene):
    pair = scene_pair(scene, 0, POINTS)
    bent = climbed(pair, name, 4.0)
    assert bent.true_rms == pytest.approx(4 * np.hypot(pair.noise, pair.candidate_noise))
    displacement = bent.points - pair.points
    along = np.einsum("ni,ni->n", displacement, pair.normals)
    assert rms(along[:, None]) == pytest.approx(bent.true_rms, rel=1e-6)
    # No affine motion explains a part of it: twelve columns, one for each parameter.
    design = np.einsum("ni,nj->nij", pair.normals, np.column_stack([pair.points, np.ones(len(along))]))
    assert np.abs(design.reshape(-1, 12).T @ along).max() < 1e-6 * np.abs(design).max() * len(along) * bent.true_rms


def test_an_affine_motion_leaves_nothing(city):
    linear = np.random.default_rng(1).normal(size=(3, 3))
    left, along = split_observable_affine(city.points, city.normals, city.points @ linear.T + [1.0, 2.0, 3.0])
    assert np.abs(along).max() < 1e-6 and rms(left) < 1e-3 * rms(city.points @ linear.T)


def test_shear_is_affine(city):
    sheared = climbed(city, "shear", 4.0)
    assert sheared.true_rms == 0
    _, along = split_observable_affine(city.points, city.normals, sheared.points - city.points)
    assert np.abs(along).max() < 1e-9


def test_a_raised_part_is_apart_by_the_stated_noise(city):
    raised = climbed(city, "raised-part", 30)
    (rows,) = np.nonzero((raised.points != city.points).any(axis=1))
    noise = np.hypot(city.noise, city.candidate_noise)
    np.testing.assert_allclose(raised.points[rows] - city.points[rows], [[0, 0, 30 * noise]] * len(rows), atol=1e-9)
    assert raised.change.size == pytest.approx(30 * noise) and len(rows) > 10
    across = raised.points[rows, :2] - raised.points[rows, :2].mean(axis=0)
    assert np.linalg.norm(across, axis=1).max() < 0.1 * city.extent
    assert {*map(tuple, raised.points[rows])} < {*map(tuple, raised.change.points)}


@pytest.mark.parametrize(("name", "level"), [("added-object", 10), ("removed-object", 10), ("moved-object", 50)])
def test_objects_are_boxes_that_hide_what_is_below(name, level, city):
    pair = climbed(city, name, level)
    side = 0.1 * city.extent
    clouds = {"added-object": [pair.points], "removed-object": [pair.reference]}.get(
        name, [pair.reference, pair.points]
    )
    added = [{*map(tuple, cloud)} & {*map(tuple, pair.change.points)} for cloud in clouds]
    assert sum(map(len, added)) == len(pair.change.points)
    tops = []
    for box, cloud in zip((np.array(sorted(points)) for points in added), clouds, strict=True):
        low, high = box.min(axis=0), box.max(axis=0)
        np.testing.assert_allclose(high - low, [side, side, side / 2], rtol=0.15)
        inside = ((cloud > low + 0.05 * side) & (cloud < high - 0.05 * side)).all(axis=1)
        assert not inside.any()
        # The top has a third of the area of top and walls.
        assert np.mean(box[:, 2] > high[2] - 0.02 * side) == pytest.approx(1 / 3, abs=1.5 / np.sqrt(len(box)))
        tops.append((low + high) / 2)
    if name == "moved-object":
        assert np.linalg.norm(tops[1] - tops[0]) == pytest.approx(side / 2, rel=0.1)
        assert pair.change.size == pytest.approx(side / 2)


def test_the_exact_part_has_the_stated_share_and_no_error(city):
    pair = climbed(city, "exact-part", 75)
    for cloud in (pair.reference, pair.points):
        middle = np.percentile(city.reference, [1, 99], axis=0).mean(axis=0)
        exact = (cloud[:, :2] == middle[:2]).any(axis=1)
        assert exact.mean() == pytest.approx(0.75, abs=1e-3)
    assert pair.true_rms == pytest.approx(4 * np.hypot(city.noise, city.candidate_noise) / 2)
    bent = pair.points[: len(city.points)] - city.points
    assert np.sqrt(np.square(np.einsum("ni,ni->n", bent, city.normals)).mean() / 4) == pytest.approx(pair.true_rms)


def test_ladders_are_described_alike():
    for name, ladder in LADDERS.items():
        assert name == ladder.name and set(ladder.subjects) <= set(PAIR_SUBJECTS.values())
        assert set(ladder.quick) <= set(ladder.levels) and set(ladder.quick_second) <= set(ladder.second_levels)
        assert len(ladder.quick) <= 3 <= len(ladder.levels)
        info = ladder.info(quick=False)
        assert info.levels == ladder.levels and info.is_map == (ladder.perturb_map is not None)
    assert {subject for ladder in LADDERS.values() for subject in ladder.subjects} == set(PAIR_SUBJECTS.values())
    info = LADDERS["degenerate"].info(quick=True)
    assert [info.level_text(level) for level in info.levels] == ["plane", "half-turn building"]


def test_documented_ladders():
    """The table of ladders in the documentation has every ladder with its levels and subjects."""
    page = (ROOT / "docs" / "howto" / "stress.md").read_text()
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| `")]
    documented = {row[0].strip("`"): row for row in rows if row[0].strip("`") in LADDERS}
    assert set(documented) == set(LADDERS)
    for name, (_, _, levels, subjects) in documented.items():
        ladder = LADDERS[name]
        texts = ladder.level_names or [f"{level:g}" for level in ladder.levels]
        assert levels.startswith(", ".join(texts)) and levels.endswith(ladder.second_unit or ladder.unit), name
        assert subjects == ", ".join(subject.name for subject in ladder.subjects), name


def test_choice_of_ladders():
    assert {ladder.name for ladder in selected(None, quick=False)} == set(LADDERS)
    assert all(ladder.quick for ladder in selected(None, quick=True))
    assert [ladder.name for ladder in selected("start-r,overlap", quick=False)] == ["start-rotation", "overlap"]
    assert {ladder.kind for ladder in selected("warp", quick=False)} == {"warp"}
    with check_error():
        selected("nothing", quick=True)
