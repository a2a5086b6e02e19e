"""Deviation maps: closed forms, and CloudCompare's own M3C2."""

import numpy as np
import oracles
import pytest
import shapes
from data_folder import data_folder
from optional import import_or_skip
from wording import check_error

from pcbench import Cloud, Settings, compare, read_cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.neighbors import Index
from pcbench.measure.deviation import Spread, m3c2

pytestmark = pytest.mark.usefixtures("without_deformation", "without_changes")

UP = np.array([0, 0, 1.0])


def test_m3c2_of_a_shifted_noisy_plane():
    rng = np.random.default_rng(0)
    reference, candidate = shapes.plane_samples(20_000, seed=1), shapes.plane_samples(30_000, seed=2)
    reference, candidate = (
        reference + rng.normal(0, 0.02, (20_000, 1)) * UP,
        candidate + rng.normal(0, 0.03, (30_000, 1)) * UP,
    )
    cores = np.array([[2.0, 2, 0], [5, 5, 0], [7, 3, 0]])
    result = m3c2(
        Index(reference), Index(candidate + 0.1 * UP), cores, np.tile(UP, (3, 1)), radius=0.5, half_length=1.0
    )
    # About 157 and 236 points per cylinder: standard errors of 1.6 and 2.0 mm.
    np.testing.assert_allclose(result.distances, 0.1, atol=0.01)
    expected = 1.96 * np.sqrt(0.02**2 / result.counts_reference + 0.03**2 / result.counts_candidate)
    np.testing.assert_allclose(result.lod, expected, rtol=0.2)
    assert result.significant.all()
    flipped_result = m3c2(
        Index(reference), Index(candidate + 0.1 * UP), cores, np.tile(-UP, (3, 1)), radius=0.5, half_length=1.0
    )
    np.testing.assert_allclose(flipped_result.distances, -result.distances)


def test_m3c2_registration_error_and_empty_cylinders():
    plane = shapes.plane_samples(5000)
    cores = np.array([[5.0, 5, 0], [50, 50, 0]])
    result = m3c2(
        Index(plane), Index(plane), cores, np.tile(UP, (2, 1)), radius=1, half_length=1, registration_error=0.01
    )
    assert result.distances[0] == 0
    assert result.lod[0] == pytest.approx(0.0196)
    assert result.significant[0] == 0
    assert np.isnan([result.distances[1], result.lod[1], result.significant[1]]).all()
    with check_error():
        m3c2(Index(plane), Index(plane), cores, np.tile(UP, (2, 1)), radius=0, half_length=1)


def test_m3c2_equals_cloudcompare():
    folder = data_folder("autzen")
    reference, candidate = (read_cloud(folder / f"autzen-bmx-{year}.las").points for year in (2010, 2023))
    columns = oracles.cloudcompare_columns(folder / "autzen-bmx-cc.txt")
    normals = np.stack([columns[f"Normal{axis}"] for axis in "XYZ"], axis=1)
    valid = np.linalg.norm(normals, axis=1) > 0.5
    normals = normals[valid] / np.linalg.norm(normals[valid], axis=1, keepdims=True)
    cores = np.stack([columns[axis] for axis in "XYZ"], axis=1)[valid]
    origin = np.floor(reference.mean(axis=0))
    result = m3c2(
        Index(reference - origin), Index(candidate - origin), cores - origin, normals, radius=2.890432, half_length=5.5
    )
    assert len(cores) == 97
    np.testing.assert_array_equal(result.counts_reference, columns["Npoints_cloud1"][valid])
    np.testing.assert_array_equal(result.counts_candidate, columns["Npoints_cloud2"][valid])
    # The file has three decimals, also for its normals; NaN occurs in the same rows.
    np.testing.assert_allclose(result.distances, columns["M3C2 distance"][valid], atol=1e-3)
    np.testing.assert_allclose(result.lod, columns["distance uncertainty"][valid], atol=1e-3)
    np.testing.assert_allclose(result.std_reference, columns["STD_cloud1"][valid], atol=1e-3)
    np.testing.assert_array_equal(np.nan_to_num(result.significant), columns["significant change"][valid])


def test_maps_of_a_shifted_plane():
    plane = shapes.plane_grid(40, 0.25)
    settings = Settings(register="none", maps=("m3c2",))
    deviation = compare(plane, plane - [0, 0, 0.1], settings).candidates[0].deviation
    np.testing.assert_allclose(deviation.scalars["distance"], 0.1)
    np.testing.assert_allclose(deviation.scalars["plane_distance"], -0.1)
    np.testing.assert_allclose(deviation.m3c2.distances, -0.1)
    assert deviation.m3c2.radius == pytest.approx(6 * 0.25)


@pytest.mark.long
def test_mesh_distances_of_a_sphere():
    icosphere = import_or_skip("trimesh").creation.icosphere(subdivisions=5)
    mesh = Mesh(np.asarray(icosphere.vertices), np.asarray(icosphere.faces))
    directions = shapes.sphere(2000, seed=3)[1]
    for radius in (1.1, 0.9):
        deviation = compare(mesh, radius * directions, Settings(register="none")).candidates[0].deviation
        # Signed, because the mesh is closed; an icosphere of 20480 faces lies at most 4e-4 inside its sphere.
        np.testing.assert_allclose(deviation.scalars["mesh_distance"], radius - 1, atol=1e-3)


@pytest.mark.long
def test_poisson_map_and_poisson_d2_of_gao2025():
    import_or_skip("open3d")
    points, normals = shapes.fibonacci_sphere(20_000, 5.0)
    settings = Settings(register="none", maps=("poisson",))
    candidate = compare(Cloud(points, normals=normals), 1.02 * points[::7], settings).candidates[0]
    # The sphere lies 0.1 outside; the Poisson surface follows the points to about a tenth of their spacing (0.1).
    np.testing.assert_allclose(np.abs(candidate.deviation.scalars["poisson_distance"]), 0.1, atol=0.02)
    preset = candidate.metrics.presets["gao2025"]
    assert preset.d2_poisson_mse == pytest.approx(0.01, rel=0.2)
    assert preset.d2_mse == pytest.approx(0.01, rel=0.2)


def test_an_unknown_map_is_refused():
    with check_error():
        Settings(maps=("x",))


def test_nmad_is_robust_against_outliers():
    """NMAD (Höhle & Höhle 2009) is the standard deviation of normal errors; outliers change it by their share."""
    errors = np.random.default_rng(3).normal(0.1, 0.02, 100_000)
    spread = Spread.of(errors)
    assert spread.median == pytest.approx(0.1, abs=3e-4)
    assert spread.std == pytest.approx(0.02, rel=0.01)
    assert spread.nmad == pytest.approx(0.02, rel=0.01)
    errors[:2000] += 5.0
    spread_with_outliers = Spread.of(errors)
    assert spread_with_outliers.nmad == pytest.approx(0.02, rel=0.05)
    assert spread_with_outliers.std > 0.5
    assert spread_with_outliers.rms**2 == pytest.approx(spread_with_outliers.bias**2 + spread_with_outliers.std**2)
    assert Spread.of(np.array([1.0, 2.0, 4.0])).nmad == pytest.approx(1.4826)
    assert Spread.of(np.zeros(0)) == Spread()


@pytest.mark.long
def test_the_poisson_map_by_meshlab_is_named_in_the_result():
    import_or_skip("pymeshlab")
    points, normals = shapes.fibonacci_sphere(4000, 10.0)
    settings = Settings(register="none", maps=("poisson-meshlab",))
    candidate = compare(Cloud(points, normals=normals), Cloud(1.01 * points[::4]), settings).candidates[0]
    # The candidate lies 0.1 outside; the mesh is within a fifth of the spacing of 0.5.
    np.testing.assert_allclose(np.abs(candidate.deviation.scalars["poisson_meshlab_distance"]), 0.1, atol=0.05)
