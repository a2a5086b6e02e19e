"""Ladders of measured noise: the errors have the quantiles and the correlation of clouds that were left out.

`benchmarks/photogrammetric_noise.py` writes the statistics of these clouds.
"""

import json

import numpy as np
import pytest
from noise_statistics import LAGS, SHARES, STATISTICS, correlation_length, statistics

from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.measure.metrics import nmad
from pcbench.studies.stress.ladders import LADDERS
from pcbench.studies.stress.ladders.photogrammetric import (
    EDGE_RADIUS,
    PATCH_CELLS,
    STRATA,
    decode_patches,
    encode_patches,
    measured_patches,
    outward_normals,
    resampled_errors,
    strata_of,
)
from pcbench.studies.stress.scenes import degenerate_pair, scene_pair

METHODS = ("mvs", "splat")
MEASURED = json.loads(STATISTICS.read_text())
UP = np.array([0.0, 0.0, 1.0])


def plane(side=140, tilt=0):
    """Return points on a square grid of spacing 1, level or upright, and their normals."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(float(side))] * 2))
    points = np.column_stack([x, y, 0 * x]) if not tilt else np.column_stack([x, 0 * x, y])
    return points, np.tile(UP if not tilt else [0.0, 1.0, 0.0], (len(points), 1))


def test_bytes_keep_errors_to_three_percent():
    values = np.concatenate([-np.geomspace(0.05, 200, 500), np.geomspace(0.05, 200, 500)])
    # Half a step of asinh is 3.3 %; near zero, where asinh is linear, it is 0.0033 NMAD.
    np.testing.assert_allclose(decode_patches(encode_patches(values)), values, rtol=0.034, atol=0.004)


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("tilt", [0, 1], ids=STRATA[:2])
def test_errors_of_a_plane_are_those_of_its_patches(method, tilt):
    patches = measured_patches(method)
    assert patches.shape == (len(STRATA), 24, PATCH_CELLS, PATCH_CELLS)
    points, normals = plane(tilt=tilt)
    draws = [resampled_errors(points, normals, patches, 1.0, np.random.default_rng(seed)) for seed in range(5)]
    errors = np.concatenate(draws)
    assert np.isin(errors, patches[tilt]).all()
    # About 200 blocks drawn from 24 patches: the quartiles of the resample vary by some 14 % of the NMAD.
    shares = (0.25, 0.5, 0.75)
    expected = np.quantile(patches[tilt], shares)
    np.testing.assert_allclose(np.quantile(errors, shares), expected, atol=0.3 * nmad(patches[tilt].ravel()))


@pytest.mark.parametrize(("method", "scene"), [(m, s) for m, scenes in MEASURED.items() for s in scenes])
def test_errors_of_a_plane_resemble_those_of_other_clouds(method, scene):
    measured = MEASURED[method][scene]["measured level"]
    points, normals = plane()
    made = statistics(
        resampled_errors(points, normals, measured_patches(method), 1.0, np.random.default_rng(1)),
        points,
        normals,
        1.0,
    )
    low, high = (np.array(made["quantiles"])[k] - made["quantiles"][3] for k in (slice(1, 3), slice(4, 6)))
    expected = np.array(measured["quantiles"]) - measured["quantiles"][3]
    # Measured clouds differ from each other by up to a factor of two in their tails; a Gaussian of the same quartiles
    # has a 95 % quantile of a third of the measured one.
    for found, wanted in zip((*low, *high), (*expected[1:3], *expected[4:6]), strict=True):
        assert 1 / 2.3 < found / wanted < 2.3
    # In the overlapping depth maps of c13, neighbours are from different maps, and less correlated than in the others.
    near, far = (np.array(made["correlations"])[k] for k in (LAGS.index(2.5), LAGS.index(16.0)))
    assert near > 0.2 > far and near == pytest.approx(measured["correlations"][LAGS.index(2.5)], abs=0.35)


def test_generated_errors_have_the_quantiles_and_the_correlation_length_of_clouds_that_were_left_out():
    """The statistics that the benchmark wrote, of errors generated on the surfaces of measured clouds."""
    for scenes in MEASURED.values():
        for found in scenes.values():
            measured, made = found["measured"], found["generated"]
            middle = slice(1, 6)  # 5 % to 95 %
            np.testing.assert_allclose(made["quantiles"][middle], measured["quantiles"][middle], rtol=0.45, atol=0.3)
            ratio = correlation_length(made["correlations"]) / correlation_length(measured["correlations"])
            assert 1 / 2.5 < ratio < 1.3  # blocks of 22 spacings cut off the correlation beyond some ten spacings
    assert SHARES[1:6] == (0.05, 0.25, 0.5, 0.75, 0.95)


def test_strata_of_a_step():
    """A level ground and a wall that meet in an edge at x = 0."""
    ground, up = plane(20)
    wall, _ = plane(20, tilt=1)
    wall = wall[:, [1, 0, 2]] + [0.0, 0.0, 0.5]
    points = np.concatenate([ground + [0.5, 0, 0], wall])
    normals = np.concatenate([up, np.tile([1.0, 0.0, 0.0], (len(wall), 1))])
    found = strata_of(normals, points, Index(points), normals, EDGE_RADIUS)
    # Within 3 of the other surface: ground at x = 0.5, 1.5 and 2.5, wall at z = 0.5, 1.5 and 2.5.
    assert np.bincount(found).tolist() == [17 * 20, 17 * 20, 3 * 20, 3 * 20]
    assert (points[found == 2, 0] < 3).all() and (points[found == 3, 2] < 3).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scene", ["city", "object"])
def test_noise_of_a_level_is_along_the_normals_with_its_nmad_in_spacings(method, scene):
    pair = scene_pair(scene, 0, 2000)
    ladder = LADDERS[f"noise-{method}"]
    noisy = ladder.apply(pair, 2.0, None, np.random.default_rng(0))
    added = noisy.points - pair.points
    outward = outward_normals(pair.points, pair.normals, MeshIndex(pair.surface), median_spacing(Index(pair.points)))
    along = np.einsum("ni,ni->n", added, outward)
    np.testing.assert_allclose(added, along[:, None] * pair.normals * sign_of(outward, pair.normals), atol=1e-12)
    assert nmad(along) == pytest.approx(2 * pair.spacing)
    assert noisy.candidate_noise == pytest.approx(np.hypot(pair.candidate_noise, 2 * pair.spacing))
    # Heavy tails: the 99 % quantile of a Gaussian's absolute value is 2.6 NMAD.
    assert np.quantile(np.abs(along - np.median(along)), 0.99) > 3 * nmad(along)
    twice = ladder.apply(pair, 4.0, None, np.random.default_rng(0)).points - pair.points
    np.testing.assert_allclose(twice, 2 * added, atol=1e-12 * pair.extent)


def sign_of(vectors, others):
    return np.sign(np.einsum("ni,ni->n", vectors, others))[:, None]


@pytest.mark.parametrize("name", ["sphere", "half-turn building", "repeated facade"])
def test_normals_point_to_the_open_side(name):
    """Half of the normals are turned; the outside is known: away from the centre, or not enclosed by the building."""
    pair = degenerate_pair(name, 0, 4000)
    turned = pair.normals * np.random.default_rng(0).choice([-1.0, 1.0], (len(pair.normals), 1))
    found = outward_normals(pair.points, turned, MeshIndex(pair.surface), pair.spacing)
    at, z = pair.points, pair.points[:, 2]
    if name == "sphere":
        assert (np.einsum("ni,ni->n", found, at) > 0).all()
    elif name == "repeated facade":
        ground = (z < 0.1) & (np.abs(found[:, 2]) > 0.99) & (at[:, 1] < -1.6)
        assert ground.sum() > 500 and (found[ground, 2] > 0).mean() > 0.99
    else:
        front = (np.abs(at[:, 1] + 6) < 0.1) & (np.abs(found[:, 1]) > 0.99)
        back = (np.abs(at[:, 1] - 6) < 0.1) & (np.abs(found[:, 1]) > 0.99)
        assert min(front.sum(), back.sum()) > 100
        assert (found[front, 1] < 0).mean() > 0.95 and (found[back, 1] > 0).mean() > 0.95


@pytest.mark.parametrize("method", METHODS)
def test_one_sided_errors_do_not_shift_walls_that_face_each_other(method):
    """Normals of unknown sides: walls keep the size of their errors, but none of their common direction."""
    points, normals = plane(tilt=1)
    arguments = (points, normals, measured_patches(method), 1.0)
    sure = resampled_errors(*arguments, np.random.default_rng(2))
    unsure = resampled_errors(*arguments, np.random.default_rng(2), oriented=False)
    np.testing.assert_array_equal(np.abs(sure), np.abs(unsure))
    assert 0.2 < (sure * unsure > 0).mean() < 0.8


def test_noise_is_correlated_between_neighbours_alone():
    pair = scene_pair("terrain", 0, 16_000)
    noisy = LADDERS["noise-mvs"].apply(pair, 1.0, None, np.random.default_rng(0))
    along = (noisy.points - pair.points)[:, 2]  # the terrain is open above
    found = statistics(along / nmad(along), pair.points, pair.normals, median_spacing(Index(pair.points)))
    assert found["correlations"][0] > 0.3 > 0.15 > found["correlations"][-1]
    shuffled = np.random.default_rng(0).permutation(along)
    lost = statistics(shuffled / nmad(along), pair.points, pair.normals, median_spacing(Index(pair.points)))
    assert abs(lost["correlations"][0]) < 0.05
