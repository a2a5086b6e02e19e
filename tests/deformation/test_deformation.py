"""Deformation: known bends come back with their size, and what is no bend is not taken for one."""

import json

import numpy as np
import pytest
from bends import SIZE, Cell, Halves, Scene, bends
from data_folder import data_folder

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.deformation import Observable, deform
from pcbench.deformation.model import Noise
from pcbench.deformation.polynomials import PARAMETERS, model_columns, monomials, normal_equations, normal_matrix
from pcbench.deformation.size import minimum_detectable_rms
from pcbench.geometry.crs import euclidean_offsets
from pcbench.scenes.synthetic import city

NOISE = Cell("gauss", 40)  # white and correlated in equal parts, over 5 m of 200 m
KINDS = tuple(bends(np.zeros((1, 3)), SIZE))
UTM = np.array([500_000.0, 4_800_000.0, 100.0])


@pytest.fixture(scope="module")
def scene():
    return Scene(8000)


@pytest.fixture(scope="module")
def waves(scene):
    return scene.waves(NOISE)


# The mathematics, piece by piece.


def test_moments_hold_the_normal_equations_of_a_cubic_field():
    rng = np.random.default_rng(0)
    places, normals = rng.uniform(-1, 1, (50, 3)), rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights, residuals = rng.random(50), rng.normal(size=50)
    design = np.einsum("an,nk->nak", monomials(places), normals).reshape(50, 60)
    starts = np.array([0, 20, 20])  # a group of twenty pairs, an empty one, the rest
    moments, scores = normal_equations(places, normals, weights, residuals, starts)
    for group, rows in enumerate((slice(0, 20), slice(20, 20), slice(20, 50))):
        matrix = design[rows].T @ (weights[rows, None] * design[rows])
        # Sums of fifty terms of size one.
        np.testing.assert_allclose(normal_matrix(moments[group]), matrix, atol=1e-12)
        np.testing.assert_allclose(scores[group].ravel(), design[rows].T @ (weights * residuals)[rows], atol=1e-12)


def test_sums_over_groups_that_are_none_are_refused():
    one, places = np.ones(4), np.zeros((4, 3))
    for starts in ([2, 1], [0, 5], [-1]):
        with pytest.raises(ValueError, match="ascending"):
            normal_equations(places, places, one, one, np.array(starts))


@pytest.mark.parametrize(
    ("smaller", "larger"), [("rigid", "similarity"), ("similarity", "affine"), ("affine", "cubic")]
)
def test_models_are_nested_and_count_their_parameters(smaller, larger):
    small, large = model_columns(smaller), model_columns(larger)
    assert np.linalg.matrix_rank(small) == small.shape[1] == PARAMETERS[smaller]
    assert np.linalg.matrix_rank(np.hstack([small, large])) == large.shape[1]


def test_rigid_fields_keep_distances_and_similar_ones_shapes():
    places = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    for model, columns in (("rigid", 6), ("similarity", 7)):
        for column in model_columns(model).T:
            moved = np.einsum("an,ak->nk", monomials(places), column.reshape(20, 3))
            # The gradient is antisymmetric, but for a scale.
            gradient = np.linalg.lstsq(places - places.mean(0), moved - moved.mean(0), rcond=None)[0]
            symmetric = gradient + gradient.T
            np.testing.assert_allclose(symmetric, symmetric[0, 0] * np.eye(3), atol=1e-12)
        assert model_columns(model).shape[1] == columns


@pytest.mark.slow
def test_covariance_of_the_modes_is_that_of_simulated_noise(scene, waves):
    """Noise of known variances is put through the same sums: their power is what was predicted."""
    step = scene.geometry.step("affine", "cubic")
    lengths = scene.geometry.lengths
    # Two kernels that together cover the area of the one that is simulated: their lengths are fixed.
    above = int(np.searchsorted(lengths, NOISE.length))
    below, beyond = lengths[above - 1] ** 2, lengths[above] ** 2
    components = np.zeros(len(lengths))
    components[above] = 0.02**2 * (NOISE.length**2 - below) / (beyond - below)
    components[above - 1] = 0.02**2 - components[above]
    predicted = np.trace(scene.geometry.covariance(step, Noise(0.02**2, components, lengths)))
    powers = []
    for seed in range(40):
        scores = scene.judge(scene.noise(NOISE, waves, seed)).scores
        powers.append(np.square(step.modes.T @ scores.total).sum())
    # Cells are coarse, and the mean of 40 runs is good to 5 %.
    assert np.mean(powers) == pytest.approx(predicted, rel=0.2)


def test_noise_comes_back(scene, waves):
    found = [scene.judge(scene.noise(NOISE, waves, seed)).noise for seed in range(10)]
    assert np.mean([np.sqrt(n.white) for n in found]) == pytest.approx(0.02, rel=0.1)
    assert np.mean([np.sqrt(n.correlated) for n in found]) == pytest.approx(0.02, rel=0.15)
    assert np.median([n.correlation_length for n in found]) == pytest.approx(5.0, rel=0.3)


# Recovery: pairs with exact planes.


def test_nothing_is_found_where_nothing_is(scene, waves):
    findings = [scene.judge(scene.noise(NOISE, waves, 100 + seed)).finding for seed in range(20)]
    assert [f.verdict for f in findings].count("none") >= 18
    assert not any(f.verdict == "non-affine" for f in findings)


@pytest.mark.parametrize("times", [1, 2, 5])
@pytest.mark.parametrize("kind", KINDS)
def test_every_bend_is_found(scene, waves, kind, times):
    bend = times * NOISE.total * scene.beyond_affine(bends(scene.places, SIZE)[kind])
    judged = scene.judge(scene.noise(NOISE, waves, 7) + bend)
    assert judged.finding.verdict == "non-affine"
    if times >= 2:
        error = np.sqrt(np.mean(np.square(scene.fitted(judged) - bend)))
        assert error <= 0.25 * times * NOISE.total


@pytest.mark.parametrize("model", ["similarity", "affine"])
def test_smaller_models_are_enough_for_smaller_deformations(scene, waves, model):
    x = scene.places
    field = 1e-3 * x if model == "similarity" else 2e-3 * x[:, [1]] * [1.0, 0.0, 0.0]
    judged = scene.judge(scene.noise(NOISE, waves, 8) + (field * scene.normals).sum(axis=1))
    assert (judged.finding.verdict, judged.finding.model) == (model, model)


@pytest.mark.slow
def test_the_dome_that_can_be_detected(scene, waves):
    noise = scene.judge(scene.noise(NOISE, waves, 9)).noise
    limit = minimum_detectable_rms(scene.geometry, noise)
    dome = scene.beyond_affine(bends(scene.places, SIZE)["dome"])

    def found(size):
        runs = [scene.judge(scene.noise(NOISE, waves, 200 + seed) + size * dome).finding for seed in range(30)]
        return np.mean([run.evidence.p_noise <= 0.01 for run in runs])

    # 80 % of such domes are found at 1 %, within the scatter of 30 runs and of the noise's estimate; of half as large
    # ones far fewer.
    assert found(limit) >= 0.6
    assert found(limit / 2) <= 0.6


# Recovery: whole clouds.


def sampled(count, rng):
    return city(3).sample(count, rng)[0]


def noisy(points, rng, size=0.02):
    return points + rng.normal(0, size, points.shape)


def dome(points, rms):
    square = np.square(points[:, :2]).sum(axis=1)
    lift = square - square.mean()
    return points + rms * (lift / lift.std())[:, None] * [0, 0, -1]


def verdict(reference, candidate, method="icp", **options):
    return deform(Cloud(reference, unit="m", **options), Cloud(candidate, unit="m"), method)[1]


def codes(found):
    return [notice.code for notice in found.warnings]


def test_a_dome_of_two_clouds_comes_back_with_its_size():
    rng = np.random.default_rng(1)
    candidate = dome(sampled(40_000, rng), 0.1)
    found = verdict(noisy(sampled(120_000, rng), rng), noisy(candidate, rng))
    assert found.verdict == "non-affine"
    # Along the normals: half of the surface is walls or steep roofs, where a lift hardly shows.
    low, high = found.amplitude.ci
    assert 0.06 < low < found.amplitude.rms < high < 0.1
    assert found.growth.with_distance.ci[1] < 0
    field = found.field
    truth = dome(field.places, 0.1) - field.places
    seen = field.counts >= 20
    vertical = np.isfinite(field.vertical) & seen
    assert np.corrcoef(field.displacements[vertical, 2], truth[vertical, 2])[0, 1] > 0.98
    # The signed means follow it within their noise.
    assert np.corrcoef(field.vertical[vertical], truth[vertical, 2])[0, 1] > 0.95


def test_a_bend_of_fifty_sigma_is_no_outlier():
    """A robust fit that grows from the rigid model would weigh it down to nothing."""
    rng = np.random.default_rng(2)
    candidate = dome(sampled(40_000, rng), 1.0)
    found = verdict(noisy(sampled(120_000, rng), rng), noisy(candidate, rng))
    assert found.verdict == "non-affine"
    assert found.amplitude.rms > 0.6
    assert found.remaining_rms < 0.05


@pytest.mark.parametrize("bend", [0.0, 0.1])
@pytest.mark.parametrize("case", ["sparse candidate", "sparse reference", "overlap", "outliers", "utm"])
def test_hard_pairs(case, bend):
    rng = np.random.default_rng(3)
    few, many = (6_000, 300_000) if case.startswith("sparse") else (50_000, 100_000)
    if case == "sparse reference":
        few, many = many, few
    reference, candidate = noisy(sampled(many, rng), rng), noisy(dome(sampled(few, rng), bend), rng)
    if case == "overlap":  # 40 % of either
        reference, candidate = reference[reference[:, 0] < 86], candidate[candidate[:, 0] > -86]
    if case == "outliers":
        strays = rng.random(len(candidate)) < 0.3
        candidate[strays] = rng.uniform([-200, -200, -5], [200, 200, 50], (int(strays.sum()), 3))
    if case == "utm":
        reference, candidate = reference + UTM, candidate + UTM
    found = verdict(reference, candidate)
    assert found.verdict == ("non-affine" if bend else "none"), found.warnings


def test_one_moved_building_is_a_local_change():
    rng = np.random.default_rng(4)
    candidate = sampled(60_000, rng)
    patches = city(3).patches
    roofs = patches.take(np.flatnonzero((patches.kind == 2) & (np.hypot(*patches.corner[:, :2].T) > 100)))
    largest = int(np.argmax(roofs.areas()))
    middle = (roofs.corner + 0.5 * (roofs.u + roofs.v))[largest, :2]
    half = 0.5 * np.abs(roofs.u + roofs.v)[largest, :2] + 0.05
    moved = (np.abs(candidate[:, :2] - middle) < half).all(axis=1)  # its walls and its roof: no ground is under it
    candidate[moved] += [0.2, 0.1, 0.1]
    found = verdict(noisy(sampled(120_000, rng), rng), noisy(candidate, rng))
    assert found.verdict == "none"
    places = found.field.places[found.field.changed]
    inside = (np.abs(places[:, :2] - middle) < half + 15).all(axis=1)
    assert inside.sum() >= 1
    assert inside.mean() >= 0.7


def test_scale_counts_only_between_metric_clouds():
    rng = np.random.default_rng(5)
    reference, candidate = noisy(sampled(80_000, rng), rng), noisy(1.002 * sampled(40_000, rng), rng)
    assert verdict(reference, candidate).verdict == "similarity"
    _, found = deform(Cloud(reference), Cloud(candidate))
    assert (found.verdict, found.model) == ("none", "similarity")
    assert codes(found) == ["scale-differs"]


def test_tilt_and_scale_left_in_by_the_registration_are_no_bend():
    rng = np.random.default_rng(6)
    tilt = np.array([[1, 0, 0.002], [0, 1, 0], [-0.002, 0, 1]])
    found = verdict(noisy(sampled(80_000, rng), rng), noisy(1.001 * sampled(40_000, rng) @ tilt.T, rng), "none")
    assert found.verdict == "similarity"


def test_shear_is_affine():
    rng = np.random.default_rng(7)
    shear = np.array([[1, 0.003, 0], [0, 1, 0], [0, 0, 1]])
    assert verdict(noisy(sampled(80_000, rng), rng), noisy(sampled(40_000, rng) @ shear.T, rng)).verdict == "affine"


def test_flat_ground_shows_no_horizontal_motion():
    rng = np.random.default_rng(8)
    ground = [np.column_stack([rng.uniform(-100, 100, (n, 2)), np.zeros(n)]) for n in (60_000, 30_000)]
    found = verdict(noisy(ground[0], rng), noisy(ground[1], rng))
    assert found.verdict == "none"
    assert found.observable == Observable(x=0.0, y=0.0, z=1.0)


def test_noise_above_an_exact_plane_is_noise():
    """Places carry the noise of the points there: a slope along z would explain all of it."""
    rng = np.random.default_rng(8)
    exact = np.column_stack([rng.uniform(-50, 50, (20_000, 2)), np.zeros(20_000)])
    points = np.column_stack([rng.uniform(-50, 50, (20_000, 2)), rng.normal(0, 0.01, 20_000)])
    found = verdict(exact, points, "none")
    assert found.verdict == "none"
    # Strays beyond the gate are not counted: less than 0.01.
    assert found.noise.sigma_white == pytest.approx(0.01, rel=0.25)
    assert found.minimum_detectable_rms > 1e-4
    low, high = verdict(exact, dome(points, 0.01), "none").amplitude.ci
    assert high - low > 1e-4


@pytest.mark.parametrize("shape", ["one place", "a line", "two places"])
def test_what_is_no_surface_is_undecided(shape):
    rng = np.random.default_rng(8)
    reference = sampled(20_000, rng)
    steps = {"one place": np.zeros(2000), "a line": np.linspace(0, 1, 2000), "two places": np.arange(2000) % 2}[shape]
    points = reference[0] + steps[:, None] * [0.0, 0.0, 30.0]
    assert verdict(reference, points, "none").verdict == "undecided"
    assert verdict(points, reference, "none").verdict == "undecided"


def test_an_exact_copy_is_not_bent():
    points = sampled(20_000, np.random.default_rng(9))
    found = verdict(points, points.copy())
    assert found.verdict == "none"
    assert found.amplitude.rms < 1e-12
    assert found.local.tiles_changed == 0


def test_too_few_points_are_undecided():
    rng = np.random.default_rng(10)
    points = sampled(250, rng)
    found = verdict(points, noisy(points, rng), "none")
    assert found.verdict == "undecided"
    assert codes(found) == ["few-pairs"]


def test_a_map_against_space_is_taken_off_first():
    """UTM heights follow the Earth: over 3 km that is a dome of 17 cm, and the grid's scale is 0.9996."""
    pytest.importorskip("pyproj")
    rng = np.random.default_rng(11)

    def terrain(count):
        xy = rng.uniform(-1500, 1500, (count, 2))
        z = 40 * np.sin(xy[:, 0] / 200) * np.cos(xy[:, 1] / 170) + 15 * np.sin(xy.sum(axis=1) / 90)
        return np.column_stack([xy, z])

    on_map = terrain(150_000) + UTM
    places = terrain(50_000) + UTM
    in_space = places + euclidean_offsets("EPSG:32632", places)
    reference = Cloud(noisy(on_map, rng), unit="m", crs="EPSG:32632")
    candidate = Cloud(noisy(in_space, rng), unit="m")
    _, found = deform(reference, candidate)
    assert found.verdict == "none"
    assert codes(found) == ["map-bend-taken-off"]
    _, unknown = deform(Cloud(reference.points, unit="m"), candidate)
    assert unknown.verdict == "non-affine"
    assert "map-not-named" in codes(unknown)


def test_the_earth_curves_by_what_it_should():
    pytest.importorskip("pyproj")
    x = np.linspace(-3000, 3000, 61)
    places = np.stack(np.meshgrid(x, x, [0.0, 100.0]), axis=-1).reshape(-1, 3) + [500_000, 5_000_000, 0]
    offsets = euclidean_offsets("EPSG:32632", places)
    edge = offsets[np.hypot(*(places[:, :2] - [500_000, 5_000_000]).T).argmax(), 2]
    middle = offsets[np.hypot(*(places[:, :2] - [500_000, 5_000_000]).T).argmin(), 2]
    # d^2 / 2R at the corner, 4243 m from the centre; the projection's own scale is left in the plane.
    assert middle - edge == pytest.approx(4243**2 / (2 * 6.37e6), rel=0.02)


def test_vegetation_is_weighed_down_by_its_class():
    rng = np.random.default_rng(12)
    ground = sampled(60_000, rng)
    square = np.square(ground[:, :2]).sum(axis=1)
    foliage = rng.random(len(ground)) < 0.15
    candidate = ground.copy()
    # Seen in leaf, higher towards the edge: it looks like bending.
    candidate[foliage, 2] += 0.08 * square[foliage] / square.max()
    classes = np.where(foliage, 5, 2).astype(np.uint8)
    reference = Cloud(noisy(sampled(120_000, rng), rng), unit="m")
    _, blind = deform(reference, Cloud(noisy(candidate, rng), unit="m"))
    _, seeing = deform(reference, Cloud(noisy(candidate, rng), unit="m", attributes={"classification": classes}))
    assert seeing.amplitude.rms < 0.5 * blind.amplitude.rms


def test_it_is_deterministic():
    rng = np.random.default_rng(13)
    reference, candidate = noisy(sampled(60_000, rng), rng), noisy(sampled(20_000, rng), rng)
    first, second = (verdict(reference, candidate) for _ in range(2))
    assert first == second
    np.testing.assert_array_equal(first.field.displacements, second.field.displacements)


# The command.


def test_deform_leaves_a_folder(tmp_path, capsys):
    from pcbench import cli

    rng = np.random.default_rng(14)
    write_cloud(tmp_path / "ref.ply", Cloud(noisy(sampled(60_000, rng), rng), unit="m"))
    write_cloud(tmp_path / "cand.ply", Cloud(noisy(dome(sampled(30_000, rng), 0.1), rng), unit="m"))
    arguments = ["deform", str(tmp_path / "ref.ply"), str(tmp_path / "cand.ply"), "--out", str(tmp_path / "bend")]
    cli.app([*arguments, "--no-figures"], standalone_mode=False)
    assert "cand.ply is bent against the reference" in capsys.readouterr().out
    values = json.loads((tmp_path / "bend/deformation.json").read_text())
    assert values["verdict"] == "non-affine"
    assert {
        "verdict", "model", "parameters", "p_value", "rungs", "amplitude", "noise", "tiles", "growth", "observable",
        "local", "minimum_detectable_rms", "warnings",
    } <= values.keys()  # fmt: skip
    assert {p.name for p in (tmp_path / "bend").iterdir()} == {
        "T.txt", "aligned.ply", "deformation.csv", "deformation.json", "deformation.ply",
    }  # fmt: skip
    field = read_cloud(tmp_path / "bend/deformation.ply")
    table = read_cloud(tmp_path / "bend/deformation.csv")
    np.testing.assert_allclose(table.points, field.points, rtol=1e-12)
    assert "displacement_z" in table.attributes
    # A second run replaces the first.
    cli.app([*arguments, "--no-figures", "-q"], standalone_mode=False)
    assert json.loads((tmp_path / "bend/deformation.json").read_text()) == values


# Real geometry and density.


@pytest.fixture(scope="module")
def lidar():
    return read_cloud(data_folder("autzen") / "autzen_trim.las")  # feet: a river's banks, trees, a stadium's edge


@pytest.mark.parametrize("seed", [15, 18])  # at 18 a field that is free among the trees finds pairs that bear it out
def test_halves_of_a_lidar_cloud_are_not_bent(lidar, seed):
    found, _ = Halves(lidar, 0.1, seed).judge(None, 0.0)
    assert found.verdict == "none", found.warnings


@pytest.mark.parametrize("kind", ["dome", "strip drift", "half wave of a sine"])
def test_bent_halves_of_a_lidar_cloud(lidar, kind):
    found, error = Halves(lidar, 0.1, 16).judge(kind, 2.0)
    assert found.verdict == "non-affine", found.warnings
    # Noise of 0.2 that is the same over 20 feet adds a bend of its own.
    assert found.amplitude.rms == pytest.approx(0.4, rel=0.15)
    assert error <= 0.25
