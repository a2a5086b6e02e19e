"""The budget of D2: closed forms of its parts, nested fits on degenerate surfaces, and what it permits to say."""

from dataclasses import replace

import numpy as np
import pytest
import shapes

from pcbench import Cloud, Settings, compare
from pcbench.changes import STABLE, UNMATCHED
from pcbench.deformation import Deformation
from pcbench.deformation.polynomials import Planes, equal_normal_equations, normal_equations
from pcbench.measure.budget import (
    CONTRADICTED,
    PARTS,
    BudgetPart,
    D2Budget,
    FitFrame,
    budget,
    consistent_with,
    sum_queries,
)

UP = np.array([0.0, 0.0, 1.0])


def budget_of(distances, places, normals=UP, labels=STABLE, *, changes=0, floor=None, white=None):
    count = len(distances)
    labels = np.broadcast_to(np.asarray(labels, np.int32), count)
    normals = np.ascontiguousarray(np.broadcast_to(normals, (count, 3)))
    frame = FitFrame.of(places)
    sums = sum_queries(distances, places, normals, None, labels, changes, frame)
    return budget(sums, frame, floor=floor, white=white)


def plane(n=40, size=10.0):
    """Return (n * n, 3) points of a symmetric grid in z = 0, within +-size, at the centres of its cells."""
    x, y = np.meshgrid(*2 * [size * (2 * np.arange(n) + 1 - n) / n])
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])


def shares(found):
    return {name: found.share(name) for name in PARTS}


def only(name):
    return pytest.approx({part: float(part == name) for part in PARTS}, abs=1e-9)  # rounding of sums of degree six


PLACES = plane()
X, Y, _ = (PLACES / 10).T


@pytest.mark.parametrize(
    ("part", "distances"),
    [
        ("motion", np.full_like(X, 0.3)),  # raised
        ("motion", 0.2 * X - 0.1 * Y + 0.3),  # raised and tilted: a plane shows no other motion
        ("smooth", X * Y),  # saddle
        ("smooth", (X**2 - np.mean(X**2)) * Y),
        ("unexplained", np.sign(np.sin(20 * X) * np.sin(20 * Y))),
    ],
)
def test_each_shape_of_a_plane_is_one_part(part, distances):
    distances = distances - (distances.mean() if part == "unexplained" else 0)
    found = budget_of(distances, PLACES)
    assert found.mean_square == pytest.approx(np.mean(distances**2), rel=1e-12)
    if part == "unexplained":
        assert found.share(part) > 0.95  # 60 parameters of 1600 points
    else:
        assert shares(found) == only(part)
        assert found.parts[part].rms == pytest.approx(np.sqrt(np.mean(distances**2)), rel=1e-6)


def test_stretch_of_a_sphere_is_affine():
    """A stretch along z by 1 % moves the surface by 0.01 z^2 along its normals; no rotation explains any of it."""
    points, normals = shapes.fibonacci_sphere(4000)
    distances = 0.01 * points[:, 2] ** 2
    assert shares(budget_of(distances, points, normals)) == only("affine")
    moved = budget_of(distances + normals @ [0.02, 0.01, -0.03], points, normals)
    # mean n_x^2 = 1/3, mean z^4 = 1/5; the points are evenly spread, within the square of their spacing.
    assert moved.motion.mean_square == pytest.approx(0.0014 / 3, rel=1e-2)
    assert moved.affine.mean_square == pytest.approx(1e-4 / 5, rel=1e-2)
    assert moved.share("motion", "affine") == pytest.approx(1, abs=1e-9)


def test_dome_has_the_squares_of_its_height():
    """A dome a (1 - r^2 / R^2) on a square: its mean is a motion, its rest smooth."""
    dome = 0.5 * (1 - (X**2 + Y**2) / 2)
    found = budget_of(dome, PLACES)
    # x^2 + y^2 on [-1, 1]^2 has mean 2/3 and variance 2 (1/5 - 1/9); the midpoint rule is exact to 1 / n^2.
    assert found.motion.mean_square == pytest.approx((0.5 * (1 - 1 / 3)) ** 2, rel=2e-3)
    assert found.smooth.mean_square == pytest.approx(0.25**2 * 2 * (1 / 5 - 1 / 9), rel=5e-3)
    assert found.share("motion", "smooth") == pytest.approx(1, abs=1e-9)


def test_points_of_changes_and_without_a_counterpart_have_their_own_parts():
    labels = np.full(len(X), STABLE)
    labels[X > 0], labels[(X > 0) & (Y > 0)], labels[(X < -0.5)] = 0, 1, UNMATCHED
    distances = np.select([labels == 0, labels == 1, labels == UNMATCHED], [1.0, -2.0, 3.0], 0.1)
    found = budget_of(distances, PLACES, labels=labels, changes=2)
    assert found.of_changes == (BudgetPart(0.25, 0.25), BudgetPart(0.25, 1.0))
    assert found.changed == BudgetPart(0.5, 1.25)
    assert found.unmatched == BudgetPart(0.25, 9 / 4)
    assert found.motion.point_share == 0.25
    assert found.motion.mean_square == pytest.approx(0.01 / 4)
    assert not found.is_noise


@pytest.mark.parametrize(("floor", "white"), [(0.01, None), (1e-4, 0.1)])
def test_noise_is_what_the_floor_or_the_white_noise_explains(floor, white):
    noise = np.random.default_rng(0).normal(0, 0.1, len(X))
    found = budget_of(noise, PLACES, floor=floor, white=white)
    assert found.share("noise") > 0.9
    assert found.is_noise
    # Twice the noise of the floor: three quarters of its square are unexplained.
    louder = budget_of(2 * noise, PLACES, floor=floor, white=white)
    assert louder.share("unexplained") == pytest.approx(0.75, abs=0.08)
    assert not louder.is_noise
    # Noise plus an offset of the same size
    raised = budget_of(noise + 0.1, PLACES, floor=floor, white=white)
    assert raised.share("motion") == pytest.approx(0.5, abs=0.05)
    assert not raised.is_noise


@pytest.mark.parametrize("curvature", [0.0, 0.05])
def test_noise_of_the_places_is_no_stretch(curvature):
    """On a plane, the height of the points is the noise of their distances; on a dome, what x^2 + y^2 leaves of it."""
    noise = np.random.default_rng(1).normal(0, 0.02, len(X))
    height = curvature * (X**2 + Y**2)
    places = PLACES + (height + noise)[:, None] * UP
    slope = -2 * curvature * np.column_stack([X, Y]) / 10
    normals = np.column_stack([slope, np.ones(len(X))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = budget_of(-noise * normals[:, 2], places, normals, floor=0.02**2)
    assert found.share("noise") > 0.9  # 60 parameters of 1600 points


def test_fits_of_pieces_add_up():
    """Sums over two pieces in one frame give the budget of all, as tiles need it."""
    points, normals = shapes.terrain(3000, seed=1)
    distances = np.random.default_rng(2).normal(0, 0.1, 3000) + 0.01 * points[:, 0]
    labels = np.where(points[:, 1] > 35, 0, STABLE).astype(np.int32)
    frame = FitFrame.of(points)

    def sums(rows):
        return sum_queries(distances[rows], points, normals, rows, labels[rows], 1, frame)

    rows = np.arange(3000)
    whole = budget(sums(rows), frame, floor=0.01)
    pieces = budget(sums(rows[::3]) + sums(rows[1::3]) + sums(rows[2::3]), frame, floor=0.01)
    for name, part in whole.parts.items():
        assert pieces.parts[name].mean_square == pytest.approx(part.mean_square, rel=1e-7, abs=1e-12)


def test_few_points_fit_few_parameters():
    rng = np.random.default_rng(3)
    for count, explained in ((100, 0), (200, 6), (400, 12), (1000, 30)):
        places = rng.uniform(-1, 1, (count, 3))
        normals = rng.normal(size=(count, 3))
        found = budget_of(rng.normal(size=count), places, normals / np.linalg.norm(normals, axis=1, keepdims=True))
        assert found.share("motion", "affine", "smooth") == pytest.approx(explained / count, abs=0.05)


def test_far_coordinates_and_units_change_no_share():
    points, normals = shapes.terrain(3000, seed=4)
    distances = np.random.default_rng(5).normal(0, 0.1, 3000) + 0.05 * np.sin(points[:, 0] / 10)
    here = shares(budget_of(distances, points, normals, floor=0.01))
    assert shares(budget_of(distances, points + 1e6, normals, floor=0.01)) == pytest.approx(here, abs=1e-6)
    scaled = budget_of(1000 * distances, 1000 * points, normals, floor=1e4)
    assert shares(scaled) == pytest.approx(here, abs=1e-6)


def test_parts_that_do_not_add_up_are_refused():
    zero = BudgetPart(1.0, 0.0)
    for parts in ((zero, BudgetPart(1.0, 0.9)), (BudgetPart(1.0, 1.1), BudgetPart(1.0, -0.1))):
        with pytest.raises(ValueError, match="add up"):
            D2Budget(1.0, None, zero, zero, (), zero, zero, zero, *parts)
    with pytest.raises(ValueError, match="add up"):  # one of two changes is missing
        D2Budget(1.0, None, zero, BudgetPart(0.5, 1.0), (BudgetPart(0.2, 0.4),), zero, zero, zero, zero, zero)


def test_budget_of_a_comparison():
    """A kept pose shows a lowered candidate as motion; registration removes it."""
    reference = Cloud(shapes.terrain(3000, seed=6)[0], unit="m")
    lowered = shapes.terrain(3000, seed=7)[0] - 0.05 * UP
    kept = compare(reference, lowered, Settings(register="none")).candidates[0]
    removed = compare(reference, lowered, Settings(register="icp")).candidates[0]
    assert kept.budget.keeps_pose
    assert kept.budget.accuracy.share("motion") > 0.9
    assert kept.budget.completeness.share("motion") > 0.9
    assert not kept.is_noise
    assert not removed.budget.keeps_pose
    assert removed.budget.accuracy.share("motion") < 0.05
    assert removed.is_noise
    same = compare(reference, reference, Settings(register="none")).candidates[0]
    assert same.budget.accuracy.mean_square == 0
    assert same.is_noise


def test_crop_counts_the_points_inside():
    reference, candidate = shapes.terrain(3000, seed=8)[0], shapes.terrain(2500, seed=9)[0]
    found = compare(reference, candidate, Settings(register="none", crop="box:5,5,-9,35,35,9")).candidates[0]
    assert found.budget.accuracy.motion.point_share == 1
    assert found.budget.completeness.motion.point_share == 1


def test_no_budget_without_normals():
    found = compare(np.eye(3)[:2], np.eye(3)[:2] + 0.1, Settings(register="none")).candidates[0]
    assert found.budget is None
    assert found.is_noise


def test_verdict_cannot_deny_what_most_of_the_distance_is():
    dome = budget_of(X**2 + Y**2 - 2 / 3, PLACES, floor=1e-4)
    equal = Deformation("none", "rigid", remaining_rms=0.0)
    checked = consistent_with(dome, equal)
    assert checked.verdict == "undecided"
    assert checked.warnings[-1].code == CONTRADICTED
    assert consistent_with(dome, replace(equal, verdict="affine")).verdict == "undecided"
    assert consistent_with(dome, replace(equal, verdict="undecided", conditional_verdict="none")).label == "undecided"
    assert consistent_with(dome, replace(equal, verdict="non-affine")).verdict == "non-affine"
    noise = budget_of(np.random.default_rng(0).normal(0, 0.1, len(X)), PLACES, floor=0.01)
    assert consistent_with(noise, equal) is equal


@pytest.mark.long
def test_exact_parts_cannot_hide_a_dome():
    """Walls that are exactly planar in both clouds get all robust weight, but not the word for the noisy ground."""

    def scene(seed, height):
        rng = np.random.default_rng(seed)
        x, y = rng.uniform(-30, 30, (2, 4000))
        z = 1.5 * np.sin(x / 3) + np.cos(y / 2.5) - height * (1 - (x**2 + y**2) / 900)
        ground = np.column_stack([x, y, z]) + rng.normal(0, 0.02, (4000, 3))
        walls = np.column_stack([rng.uniform(-30, 30, 4000), np.zeros(4000), rng.uniform(0, 4, 4000)])
        walls[1::2] = walls[1::2][:, [1, 0, 2]]
        return np.concatenate([ground, walls])

    found = compare(scene(1, 0.0), scene(2, 0.4)).candidates[0]
    assert found.budget.accuracy.share("smooth") > 0.5
    assert not found.is_noise
    assert found.deformation.verdict in ("undecided", "non-affine")


@pytest.mark.parametrize("rows", [None, slice(None, None, -1)])
def test_equal_pairs_are_those_of_weight_one(rows):
    points, normals = shapes.terrain(700, seed=1)
    distances = np.random.default_rng(2).normal(0, 0.1, 700)
    rows = None if rows is None else np.arange(700)[rows]
    queries = np.flatnonzero(distances > -0.05)
    planes = Planes(points, normals, rows, points.mean(axis=0), 30.0)
    place = queries if rows is None else rows[queries]
    here = (points[place] - planes.center) / planes.radius
    expected = normal_equations(here, normals[place], np.ones(len(queries)), distances[queries] / planes.radius)
    for found, each in zip(equal_normal_equations(planes, distances, queries), expected, strict=True):
        np.testing.assert_array_equal(found, each[0])
    for nothing in equal_normal_equations(planes, distances, queries[:0]):
        assert not nothing.any()


def test_equal_pairs_outside_their_arrays_are_refused():
    planes = Planes(PLACES, np.tile(UP, (len(PLACES), 1)), None, np.zeros(3), 1.0)
    for queries in ([-1], [len(PLACES)]):
        with pytest.raises(IndexError, match="queries that have distances"):
            equal_normal_equations(planes, np.zeros(len(PLACES)), np.array(queries))
    with pytest.raises(ValueError, match="one place for each distance"):
        equal_normal_equations(planes, np.zeros(2), np.zeros(1, np.int64))
