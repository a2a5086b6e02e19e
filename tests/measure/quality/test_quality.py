"""Quality of one cloud: known noise, double walls, voids, strips and tilt are recovered, and absent ones not found."""

import math

import numpy as np
import pytest
from data_folder import data_folder
from quality_clouds import building, floor, turned, wall
from wording import check_error

from pcbench import read_cloud
from pcbench.geometry.neighbors import Index
from pcbench.measure.quality import strips
from pcbench.measure.quality.bootstrap import BlockEstimate, mean_estimate, median_estimate, root_mean_square_estimate
from pcbench.measure.quality.coordinates import coordinate_faults
from pcbench.measure.quality.entropy import map_entropy
from pcbench.measure.quality.groups import PointGroups
from pcbench.measure.quality.numbers import better_cloud, have_equal_density, quality_numbers
from pcbench.measure.quality.outliers import find_outliers
from pcbench.measure.quality.patches import fit_patches, seeds_of
from pcbench.measure.quality.quality import CloudData, measure_quality
from pcbench.measure.quality.settings import QualitySettings
from pcbench.measure.quality.sheets import double_walls
from pcbench.measure.quality.strips import strip_names
from pcbench.measure.quality.upright import wall_tilt

TEN_PERCENT = 0.1  # the accuracy that the documentation states for made clouds
ORIGIN = np.array([5e5, 5.4e6, 300.0])


def measure(points, normals=None, settings=None, **attributes):
    return measure_quality(CloudData(points, attributes, normals), settings or QualitySettings())[0]


@pytest.mark.parametrize("noise", [0.004, 0.03])
def test_noise_is_recovered_far_from_the_origin(noise):
    rng = np.random.default_rng(0)
    points = np.vstack([floor(rng, 5000, 5, noise), wall(rng, 2500, 5, 3, noise)]) + ORIGIN
    surface = measure(points).surface
    assert surface.noise.value == pytest.approx(noise, rel=TEN_PERCENT)
    # The interval is that of the median over patches: it holds the truth up to the bias of a robust spread, a few per
    # cent.
    assert surface.noise.low < 1.05 * noise and surface.noise.high > 0.95 * noise
    assert surface.thickness.value == pytest.approx(2 * 1.645 * noise, rel=0.15)  # 5 to 95 % of a normal distribution
    assert surface.flat_share.value > 0.9


def test_a_curved_surface_without_noise_has_relief_but_no_noise():
    rng = np.random.default_rng(0)
    angle, z = rng.uniform(0, 2 * np.pi, 8000), rng.uniform(0, 4, 8000)
    surface = measure(np.column_stack([np.cos(angle), np.sin(angle), z])).surface
    assert surface.noise.value < 0.05 * surface.roughness.value  # a cylinder differs from its parabola to fourth order


@pytest.mark.parametrize("separation", [0.06, 0.25, 0.6])
def test_a_double_wall_is_found_with_its_distance(separation):
    rng = np.random.default_rng(1)
    points = np.vstack([wall(rng, 8_000, 6, 3, 0.008, separation), floor(rng, 8_000, 6, 0.008) + [0, 0.3, 0]])
    quality = measure(points)
    walls = quality.double_walls
    assert len(walls.walls) == 1
    assert walls.separation.value == pytest.approx(separation, rel=TEN_PERCENT)
    assert abs(walls.walls[0].centre[1] - separation / 2) < separation
    assert 0.5 * 18 < walls.walls[0].area < 1.1 * 18  # places near an edge see one side only
    assert quality.surface.noise.value == pytest.approx(0.008, rel=TEN_PERCENT)  # the distance is no noise


def test_sheets_that_face_opposite_ways_are_a_thin_wall():
    rng = np.random.default_rng(1)
    points = wall(rng, 12_000, 6, 3, 0.004, 0.1)
    front = np.where(points[:, 1] > 0.05, 1.0, -1.0)
    index, (spacing, step) = Index(points), (0.015, 0.0)
    for sides, count in ((None, 1), (front, 0), (np.ones(len(points)), 1)):
        normals = None if sides is None else np.outer(sides, [0, 1, 0])
        assert len(double_walls(index, spacing, step, None, 0, normals).walls) == count


def test_steps_rounding_and_single_walls_are_no_double_walls():
    rng = np.random.default_rng(2)
    stairs = floor(rng, 12_000, 5, 0.003)
    stairs[:, 2] += 0.15 * np.floor(stairs[:, 0] / 0.3)
    rounded = np.round(floor(rng, 12_000, 5, 0.01), 2)
    for points, step in ((stairs, 0.0), (rounded, 0.01), (wall(rng, 12_000, 6, 3, 0.01), 0.0)):
        assert not double_walls(Index(points), 0.02, step, None, 0).walls


def test_narrow_roofs_beside_ground_are_no_double_walls():
    for width, distance in ((5, 25), (8, 30)):
        points = floor(np.random.default_rng(4), 20_000, 100, 0.05)
        points[:, 2] += 4.0 * (points[:, 0] % distance < width)
        assert not double_walls(Index(points), 0.5, 0.0, None, 0).walls


def test_voids_are_found_with_their_areas_and_those_at_water_are_told_apart():
    rng = np.random.default_rng(3)
    points = floor(rng, 10_000, 100, 0.05)
    places = np.array([[25, 25], [70, 65]])
    distances = np.linalg.norm(points[:, None, :2] - places, axis=2)
    kept = (distances > [12, 20]).all(axis=1)
    classes = np.where(distances[:, 1] < 26, 9, 2)
    quality = measure(points[kept] + ORIGIN, classification=classes[kept])
    water, other = quality.voids.voids
    assert (water.is_at_water, other.is_at_water) == (True, False)
    assert other.area == pytest.approx(math.pi * 12**2, rel=TEN_PERCENT)
    assert water.area == pytest.approx(math.pi * 20**2, rel=TEN_PERCENT)
    assert (other.x, other.y) == pytest.approx((ORIGIN[:2] + places[0]).tolist(), abs=1.0)  # a spacing is 1 m
    assert quality.voids.least_area == pytest.approx(16 * quality.density.pulse_spacing**2)
    assert quality.density.plan.value == pytest.approx(1.0, rel=0.05)
    assert quality.voids.counted == (other,)


def test_first_returns_give_the_pulse_density():
    rng = np.random.default_rng(4)
    points = floor(rng, 10_000, 70.7, 0.05)
    numbers = np.where(rng.random(len(points)) < 0.25, 2, 1)
    density = measure(points, return_number=numbers).density
    assert density.plan.value == pytest.approx(2.0, rel=0.05)
    assert density.pulse.value == pytest.approx(1.5, rel=0.05)
    assert density.pulse_spacing == pytest.approx(1.5**-0.5, rel=0.05)
    # Strewn pulses leave exp(-4) of the cells of twice the spacing empty.
    assert density.filled_share == pytest.approx(1 - math.exp(-4), abs=0.01)


def test_offsets_of_strips_are_recovered_on_a_slope():
    rng = np.random.default_rng(5)
    points = floor(rng, 10_000, 42.4, 0.02)
    strip = rng.integers(0, 2, len(points))
    points[:, 2] += 0.2 * points[:, 0] + 0.05 * strip
    strips = measure(points, point_source_id=7 + strip).strips
    (pair,) = strips.pairs
    assert (strips.field, pair.first, pair.second) == ("point_source_id", "7", "8") and pair.places > 100
    assert pair.dz.value == pytest.approx(0.05, rel=TEN_PERCENT)
    assert pair.dz.low < 0.05 < pair.dz.high and pair.dz.low > 0
    assert pair.rms_dz.value == pytest.approx(0.05, rel=0.15)  # the noise of the means adds to it
    assert pair.rms_normal.value < pair.rms_dz.value


def test_offsets_of_strips_do_not_depend_on_the_places_at_once(monkeypatch):
    rng = np.random.default_rng(15)
    points, strip, count, radius = floor(rng, 2000, 10, 0.02), rng.integers(-1, 3, 2000), 3, 0.8
    index, seeds = Index(points), points[:100]
    groups = PointGroups.of(index.query_radius(seeds, radius), points)
    expected = seeds, *strips._offsets_at(groups, strip, count, seeds, radius)
    assert np.isfinite(expected[2]).mean() > 0.5
    for rows in (strips._CHUNK_ROWS, 1):
        monkeypatch.setattr(strips, "_CHUNK_ROWS", rows)
        for values, of_all in zip(strips._offsets(index, strip, count, seeds, radius), expected, strict=True):
            np.testing.assert_array_equal(values, of_all)


def test_strips_are_told_apart_by_the_first_field_that_does():
    times = np.repeat([1e8, 1e8 + 100], 300) + np.arange(600) * 1e-3
    files = np.repeat([1, 2, 3], 200)
    flights = {"gps_time": times, "flight": np.repeat([4, 5], 300)}
    for wanted, attributes, expected in (
        ("auto", {"point_source_id": np.ones(600), "gps_time": times}, "gps_time"),
        ("auto", {"point_source_id": np.ones(600)}, "file"),
        ("flight", flights, "flight"),
        ("none", flights, "none"),
    ):
        field, strips, names = strip_names(attributes, files, wanted)
        assert field == expected
        assert (len(names), len(strips)) == {"file": (3, 600), "none": (0, 0)}.get(expected, (2, 600))
    with check_error():
        strip_names({"intensity": np.ones(600)}, None, "swath")


@pytest.mark.parametrize("tilt", [0.0, 1.5])
def test_the_tilt_of_a_building_is_recovered(tilt):
    points = turned(building(np.random.default_rng(6), 20_000, 0.006), tilt)
    upright = wall_tilt(fit_patches(Index(points), seeds_of(points, 0.5, 0), 0.5, 12, 0), 0)
    assert upright.walls >= 6
    assert upright.tilt_deg.value == pytest.approx(tilt, abs=max(TEN_PERCENT * tilt, 0.1))
    # A length of a vector is never 0: with 7 walls, the noise of 6 mm over 3 m alone makes some hundredths of a degree.
    assert upright.tilt_deg.low - 0.03 <= tilt <= upright.tilt_deg.high + 0.03
    if tilt:  # turned about x, the tops lean to -y
        assert upright.azimuth_deg == pytest.approx(180, abs=5)


def test_parallel_walls_and_few_walls_have_no_tilt():
    rng = np.random.default_rng(7)
    walls = [wall(rng, 2000, 6, 3, 0.004) + [0, 2 * k, 0] for k in range(7)]
    for points, reason in ((np.vstack(walls), "all walls are parallel"), (walls[0], "fewer than 6 walls")):
        upright = wall_tilt(fit_patches(Index(points), seeds_of(points, 0.4, 0), 0.4, 12, 0), 0)
        assert upright.why_not == reason and upright.tilt_deg is None


def test_entropy_and_plane_variance_are_those_of_a_direct_evaluation():
    points = np.random.default_rng(8).normal(size=(400, 3)) * [3, 2, 0.1]
    radius, least = 1.2, 10
    entropies, variances = [], []
    for point in points:
        near = points[np.linalg.norm(points - point, axis=1) <= radius]
        if len(near) >= least:
            covariance = np.cov(near.T)
            entropies.append(0.5 * math.log(np.linalg.det(2 * math.pi * math.e * covariance)))
            variances.append(np.linalg.eigvalsh(covariance)[0])
    entropy = map_entropy(Index(points), radius, least, seed=0)
    # Both are sums of some hundred products in float64.
    assert entropy.entropy.value == pytest.approx(np.mean(entropies), rel=1e-9)
    assert entropy.plane_variance.value == pytest.approx(np.mean(variances), rel=1e-9)
    assert entropy.used_share == len(entropies) / len(points)
    assert map_entropy(Index(points * [1, 1, 0]), radius, least, seed=0) is None  # points in a plane have no volume


def test_isolated_points_and_groups_are_outliers_and_the_far_part_of_a_sweep_is_not():
    rng = np.random.default_rng(9)
    reach = 60 * rng.random(20_000) ** 3 + 1  # a sweep: density falls with distance
    angle = rng.uniform(0, 2 * np.pi, len(reach))
    sweep = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), rng.normal(0, 0.02, len(reach))])
    strays = np.array([[0, 0, 30.0], [5, 5, 20], [5.1, 5, 20], [5, 5.1, 20]])
    outliers, mask = find_outliers(Index(np.vstack([sweep, strays])), 1.0)
    assert mask[-4:].all()
    assert outliers.number <= 4 + 1e-3 * len(sweep)  # a few at the rim


def test_missing_data_copies_and_rounding_are_counted():
    rng = np.random.default_rng(10)
    points = np.round(floor(rng, 5000, 50, 0.02) + ORIGIN, 3)
    faulty = np.vstack([points, points[:7], np.tile([0.0, 0, 0], (200, 1)), [[5e5, 5.4e6, -9999], [5e5, 5.4e6, 1e38]]])
    faults, missing = coordinate_faults(faulty)
    assert (faults.points, faults.missing, faults.at_origin, faults.copies) == (5209, 202, 200, 7)
    assert missing[-202:].all() and "-9999" in faults.missing_text
    assert faults.steps == pytest.approx((0.001, 0.001, 0.001))
    assert faults.float32_step == 0.5  # of 5.4e6
    assert measure(faulty).surface.noise.value == pytest.approx(0.02, rel=TEN_PERCENT)


def test_float32_coordinates_have_their_step():
    points = (floor(np.random.default_rng(11), 5000, 50, 0.02) + ORIGIN).astype(np.float32).astype(np.float64)
    faults, _ = coordinate_faults(points)
    assert max(faults.steps) == faults.float32_step == 0.5


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 3)),
        np.ones((50, 3)),
        np.outer(np.arange(200.0), [1, 2, 3]),
        np.column_stack([np.random.default_rng(0).random((300, 2)), np.zeros(300)]),
        np.random.default_rng(0).random((5, 3)),
        np.random.default_rng(0).random((40, 3)) * 1e90,
    ],
    ids=["one", "equal", "line", "plane", "five", "huge"],
)
def test_clouds_without_a_surface_have_numbers_or_none(points):
    numbers = quality_numbers(measure(points), None)
    assert numbers["points"].value == len(points)
    assert all(number.value is None or math.isfinite(number.value) for number in numbers.values())


def test_the_same_seed_gives_the_same_numbers():
    points = building(np.random.default_rng(12), 6000, 0.01)
    assert quality_numbers(measure(points), "m") == quality_numbers(measure(points), "m")


def test_better_is_what_intervals_tell_apart():
    rng = np.random.default_rng(13)
    clouds = [quality_numbers(measure(floor(rng, 6000, 5, noise)), "m") for noise in (0.01, 0.02, 0.01)]
    assert better_cloud("noise", clouds[0], clouds[1]) == 1 and better_cloud("noise", clouds[1], clouds[0]) == 2
    assert better_cloud("noise", clouds[0], clouds[2]) == 0
    assert better_cloud("tilt", clouds[0], clouds[1]) is None and better_cloud("points", *clouds[:2]) is None
    sparse = quality_numbers(measure(floor(rng, 2000, 5, 0.01)), "m")
    assert not have_equal_density(clouds[0], sparse) and better_cloud("map_entropy", clouds[0], sparse) is None


def test_estimates_have_intervals_from_blocks():
    rng = np.random.default_rng(14)
    blocks = np.repeat(np.arange(50), 20)
    shared = rng.normal(0, 1, 50)[blocks] + rng.normal(0, 0.1, 1000)  # neighbours are correlated
    for estimate in (mean_estimate(shared, blocks, 0), median_estimate(shared, blocks, 0)):
        assert estimate.low < 0 < estimate.high and estimate.high - estimate.low > 2 * 1.5 / math.sqrt(50)
    assert root_mean_square_estimate(np.full(1000, -2.0), blocks, 0) == BlockEstimate(2.0, 2.0, 2.0)
    assert not mean_estimate(shared, np.zeros(1000, dtype=int), 0).has_interval
    assert median_estimate(np.empty(0), np.empty(0, dtype=int), 0) is None


def test_real_sweeps_and_trees_have_no_double_walls_and_few_outliers():
    cloud = read_cloud(data_folder("scans") / "vehicle0.xyz")
    quality = measure(cloud.points)
    assert not quality.double_walls.walls and quality.outliers.share < 1e-3
    assert quality.upright.tilt_deg is None and quality.voids is None
    trees = read_cloud(data_folder("wild") / "MixedConifer.laz").points
    assert not double_walls(Index(trees - trees.mean(axis=0)), 0.4, 0.01, None, 0).walls
