"""M3C2 with explicit settings, compared with a brute-force version written from the paper."""

import json

import numpy as np
import oracles
import pytest
import shapes
from command_line import is_one_line
from data_folder import data_folder
from wording import check_error, check_text

import pcbench
from pcbench import Cloud, M3C2Settings, Settings, compare, read_cloud, write_cloud
from pcbench.registration import ControlPoints

pytestmark = pytest.mark.usefixtures("without_deformation", "without_changes")

PARAMETERS = {"radius": 1.2, "depth": 1.5, "normal_radius": 1.5, "registration_error": 0.02}


@pytest.fixture(scope="module")
def pair():
    reference, _ = shapes.terrain(3000, seed=1)
    candidate, _ = shapes.terrain(2000, seed=2)
    cores, _ = shapes.terrain(40, seed=3)
    cores[-1] += [0, 0, 1000]  # far away, with empty cylinders
    return reference, candidate + [0, 0, 0.15], cores


def assert_m3c2_equals(result, expected):
    np.testing.assert_array_equal(result.counts_reference, expected["counts"][:, 0])
    np.testing.assert_array_equal(result.counts_candidate, expected["counts"][:, 1])
    np.testing.assert_allclose(result.distances, expected["distances"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.lod, expected["lod"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("origin", [0.0, 4e5])
def test_explicit_settings_equal_brute_force(pair, origin):
    reference, candidate, cores = (points + origin for points in pair)
    normals = oracles.m3c2_normals(pair[0], pair[2], PARAMETERS["normal_radius"])
    expected = oracles.m3c2(*pair, normals, PARAMETERS["radius"], PARAMETERS["depth"], PARAMETERS["registration_error"])
    assert np.isnan(expected["distances"][-1])
    assert np.isfinite(expected["distances"][:-1]).all()
    settings = Settings(register="none", m3c2=M3C2Settings(**PARAMETERS, cores=cores))
    result = compare(reference, candidate, settings)["candidate_1"].deviation.m3c2
    np.testing.assert_allclose(result.cores, cores)
    if origin == 0:
        assert_m3c2_equals(result, expected)
    else:  # coordinates of 4e5 are rounded to 6e-11, so a point on a cylinder's wall may change sides
        np.testing.assert_allclose(result.distances, expected["distances"], atol=1e-3)


def test_normals_of_core_points_are_used_if_present(pair):
    reference, candidate, cores = pair
    normals = np.tile([0.6, 0.0, 0.8], (len(cores), 1))
    normals[3] = 0  # no normal
    settings = Settings(register="none", m3c2=M3C2Settings(1.2, 1.5, cores=Cloud(cores, normals=2 * normals)))
    result = compare(reference, candidate, settings)["candidate_1"].deviation.m3c2
    has_normal = np.arange(len(cores)) != 3
    expected = oracles.m3c2(
        reference, candidate, cores[has_normal], normals[has_normal], 1.2, 1.5, result.registration_error
    )
    np.testing.assert_allclose(result.distances[has_normal], expected["distances"], rtol=0, atol=1e-9)
    assert np.isnan([result.distances[3], result.lod[3], *result.normals[3]]).all()


def test_compare_equals_cloudcompare_at_its_core_points():
    folder = data_folder("autzen")
    reference, candidate = (read_cloud(folder / f"autzen-bmx-{year}.las").points for year in (2010, 2023))
    columns = oracles.cloudcompare_columns(folder / "autzen-bmx-cc.txt")
    cores, normals = (
        np.stack([columns[name] for name in group], axis=1) for group in ("XYZ", ("NormalX", "NormalY", "NormalZ"))
    )
    settings = M3C2Settings(2.890432, 5.5, cores=Cloud(cores, normals=normals), registration_error=0)
    result = compare(reference, candidate, Settings(register="none", m3c2=settings))["candidate_1"].deviation.m3c2
    valid = np.linalg.norm(normals, axis=1) > 0.5
    np.testing.assert_array_equal(result.counts_candidate[valid], columns["Npoints_cloud2"][valid])
    # The file has three decimals; NaN occurs in the same rows.
    np.testing.assert_allclose(result.distances[valid], columns["M3C2 distance"][valid], atol=1e-3)
    np.testing.assert_allclose(result.lod[valid], columns["distance uncertainty"][valid], atol=1e-3)


def test_unset_parameters_have_defaults(pair):
    reference, candidate, _ = pair
    default = compare(reference, candidate, Settings(register="none", maps=("m3c2",)))["candidate_1"].deviation.m3c2
    halved = compare(reference, candidate, Settings(register="none", m3c2=f"depth={default.radius / 2}"))
    halved = halved["candidate_1"].deviation.m3c2
    np.testing.assert_array_equal(halved.cores, default.cores)
    assert (halved.radius, halved.half_length) == (default.radius, default.radius / 2)


def flat_site(seed, lowered=0.0):
    """Flat ground of 20 m x 20 m with noise of 5 mm, of which the half with negative x is lowered."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-10, 10, (5_000, 2)), rng.normal(0, 0.005, 5_000)])
    points[points[:, 0] < 0, 2] -= lowered
    return points


@pytest.mark.parametrize("method", ["none", pcbench.Similarity(np.eye(3), np.zeros(3))])
def test_a_given_pose_has_no_registration_error(method):
    reference, candidate = flat_site(0), flat_site(1, lowered=0.05)
    cores = np.column_stack([np.random.default_rng(2).uniform(-9, 9, (200, 2)), np.zeros(200)])
    settings = Settings(register=method, m3c2=M3C2Settings(cores=cores))
    found = compare(reference, candidate, settings)["candidate_1"].deviation.m3c2
    assert found.registration_error == 0
    levels = []
    for core, normal in zip(found.cores, found.normals, strict=True):
        variance = 0.0
        for cloud in (reference, candidate):
            along = (cloud - core) @ normal
            across = np.linalg.norm(cloud - core - along[:, None] * normal, axis=1)
            heights = along[(across <= found.radius) & (np.abs(along) <= found.half_length)]
            variance += heights.var() / len(heights)
        levels.append(1.96 * np.sqrt(variance))
    np.testing.assert_allclose(found.lod, levels, rtol=1e-9)  # sums of hundreds of numbers
    is_lowered = found.cores[:, 0] < -found.radius
    assert found.significant[is_lowered].mean() > 0.999  # 0.05 is more than 30 standard errors
    # 5 % of about 90 by the level: less than 14 with a probability of 0.999.
    assert found.significant[found.cores[:, 0] > found.radius].mean() < 0.15


def test_control_points_determine_the_registration_error():
    """Four points at the corners of a square of side 2a, with heights off by +e and -e in turn.

    No motion explains these residuals. Twelve numbers less six of the motion leave six degrees of freedom, so that the
    variance of a height is 4 e^2 / 6. The variance of the fitted plane is that times 1/4 + (x^2 + y^2) / (4 a^2).
    """
    a, e = 8.0, 0.01
    fixed = np.array([[-a, -a, 0], [a, -a, 0], [a, a, 0], [-a, a, 0.0]])
    pairs = ControlPoints(fixed + [[0, 0, e], [0, 0, -e], [0, 0, e], [0, 0, -e]], fixed, with_scale=False)
    found = compare(flat_site(0), flat_site(1, lowered=0.05), Settings(register=pairs, maps=("m3c2",)))
    found = found["candidate_1"].deviation.m3c2
    squares = np.square(found.cores[:, :2]).sum(axis=1)
    expected = np.sqrt(4 * e**2 / 6 * np.mean(1 / 4 + squares / (4 * a**2)))
    assert found.registration_error == pytest.approx(expected, rel=0.01)  # normals are not exactly vertical


def hills(seed, lowered=0.0):
    """Hills of 60 m x 60 m with noise of 2 cm, of which a corner of a ninth of the area is lowered."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-30, 30, (2, 10_000))
    z = 1.5 * np.sin(x / 3) + np.cos(y / 2.5) + rng.normal(0, 0.02, len(x))
    z[(x > 10) & (y > 10)] -= lowered
    return np.column_stack([x, y, z])


@pytest.mark.parametrize("lowered", [0.0, 0.5])
def test_the_registration_error_of_icp_is_that_of_the_stable_area(lowered):
    found = compare(hills(0), hills(1, lowered=lowered), Settings(m3c2="radius=1.5"))["candidate_1"]
    pose, map_ = found.registration.T_reference_candidate, found.deviation.m3c2
    error = np.einsum("ni,ni->n", pose.apply(map_.cores) - map_.cores, map_.normals)
    # The estimate includes errors beside that of the pose: planes are not the surface, and heights vary in a cylinder.
    assert np.sqrt(np.mean(np.square(error))) / 2 < map_.registration_error < 0.02
    is_lowered = (map_.cores[:, :2] > 12).all(axis=1)
    assert (np.nanmean(map_.significant[is_lowered]) > 0.9) == (lowered > 0)


def test_levels_of_detection_are_those_of_py4dgeo():
    """py4dgeo estimates variances with n - 1 points, and otherwise the same level of detection."""
    py4dgeo = pytest.importorskip("py4dgeo", reason="py4dgeo is not installed: pip install py4dgeo")
    reference, candidate = flat_site(0), flat_site(1, lowered=0.05)
    cores = np.column_stack([np.random.default_rng(2).uniform(-9, 9, (50, 2)), np.zeros(50)])
    peer = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(reference), py4dgeo.Epoch(candidate)),
        corepoints=cores,
        cyl_radius=0.5,
        normal_radii=[2.0],
        max_distance=0.5,
        registration_error=0.0,
    )
    distances, levels = peer.run()
    normals = peer.directions() * np.sign(peer.directions()[:, 2:])
    settings = M3C2Settings(radius=0.5, depth=0.5, cores=Cloud(cores, normals=normals))
    found = compare(reference, candidate, Settings(register="none", m3c2=settings))["candidate_1"].deviation.m3c2
    np.testing.assert_allclose(np.abs(found.distances), np.abs(distances), atol=1e-9)
    unbiased = sum(
        std**2 / (count - 1)
        for std, count in (
            (found.std_reference, found.counts_reference),
            (found.std_candidate, found.counts_candidate),
        )
    )
    np.testing.assert_allclose(1.96 * np.sqrt(unbiased), levels["lodetection"], rtol=1e-6)


def test_core_points_outside_the_region_are_left_out(pair):
    reference, candidate, cores = pair
    low, high = np.median(cores[:, 0]), cores[:-1].max(axis=0) + 1
    box = f"box:{low},-1000,-1000,{high[0]},1000,1000"
    settings = Settings(register="none", crop=box, m3c2=M3C2Settings(1.2, cores=cores))
    result = compare(reference, candidate, settings)["candidate_1"].deviation.m3c2
    inside = cores[(cores[:, 0] >= low) & (cores[:, 2] < 1000)]
    np.testing.assert_allclose(result.cores, inside)
    with check_error():
        compare(reference, candidate, Settings(register="none", m3c2=M3C2Settings(1.2, cores=cores[-1:]), crop=box))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "0.5",
        "scale=2",
        "radius=0.5,dept=2",
        "radius=a",
        "radius=",
        "radius=1,radius=2",
        "radius=0",
        "depth=-1",
        "normal_radius=nan",
        "registration_error=-1",
    ],
)
def test_invalid_texts_are_refused(text):
    with check_error():
        Settings(m3c2=text)


def test_settings_survive_a_round_trip_through_text():
    settings = M3C2Settings.parse("radius=0.5, depth=2 ,cores=a, b.ply")
    assert (settings.radius, settings.depth, settings.normal_radius) == (0.5, 2.0, None)
    assert str(settings.cores) == "a, b.ply"
    assert M3C2Settings.parse(settings.text).text == settings.text
    assert Settings(m3c2="radius=1").maps == ("m3c2",)
    for value in (3, True, {"radius": 1}):
        with check_error():
            Settings(m3c2=value)
    with check_error():
        M3C2Settings("0.5")


def test_saved_settings_repeat_the_result_of_the_command_line(pair, tmp_path, run):
    for name, points in zip(("r.ply", "c.ply", "cores.xyz"), pair, strict=True):
        write_cloud(tmp_path / name, Cloud(points))
    files = [tmp_path / "r.ply", tmp_path / "c.ply"]
    m3c2_text = f"radius=1.2,depth=1.5,normal_radius=1.5,cores={tmp_path / 'cores.xyz'},registration_error=0.02"
    options = ["--register", "none", "--m3c2", m3c2_text]
    assert run("compare", *files, *options, "--out", tmp_path / "report")[0] == 0
    result = json.loads((tmp_path / "report" / "comparison.json").read_text())["candidates"][0]["deviation"]["m3c2"]
    assert (result["radius"], result["half_length"], result["registration_error"]) == (1.2, 1.5, 0.02)
    assert (result["core_points"], result["valid"]) == (40, 39)
    settings = json.loads((tmp_path / "report" / "settings.json").read_text())
    assert settings["files"][0]["path"] == str(tmp_path / "cores.xyz")
    code, _, _ = run("compare", "--settings", tmp_path / "report" / "settings.json", "--json", tmp_path / "again.json")
    assert code == 0
    assert json.loads((tmp_path / "again.json").read_text())["candidates"][0]["deviation"]["m3c2"] == result
    for text, expected in ((f"cores={tmp_path / 'no.ply'}", "no.ply"), ("diameter=1", "diameter=1")):
        code, _, err = run("compare", *files, "--m3c2", text)
        assert code == 2
        assert is_one_line(err)
        assert expected in err


def test_cylinders_with_too_few_points_give_a_warning(pair):
    reference, candidate, _ = pair

    def empty_cylinder_warnings(text):
        result = compare(reference, candidate, register="none", m3c2=text).candidates[0]
        return [str(notice) for notice in result.warnings if notice.code == "empty-m3c2"]

    assert empty_cylinder_warnings("radius=1.2") == []
    (text,) = empty_cylinder_warnings("radius=1e-9")
    check_text(text, masked=False)
