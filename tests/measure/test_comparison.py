"""The pipeline: closed forms, brute force, invariances, determinism and refusals."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import oracles
import pytest
import shapes
from optional import import_or_skip
from shapes import UTM_WHOLE as UTM
from wording import check_error, check_text

from pcbench import Cloud, Settings, Sphere, compare
from pcbench.errors import RegistrationError
from pcbench.geometry.regions import Box
from pcbench.geometry.transform import Similarity, format_matrix
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE
from pcbench.registration import IcpSettings, advice
from pcbench.report import document, to_json
from pcbench.report.notes import warnings
from pcbench.report.plot import Drawn
from pcbench.report.table import rows

pytestmark = pytest.mark.usefixtures("without_deformation", "without_changes")

NO_REGISTRATION = Settings(register="none")


def round_to_grid(points):
    """Round to 2^-20: coordinates up to 8e6 are then exact."""
    return np.round(points * 2**20) / 2**20


def metrics_of(reference, candidate, settings=NO_REGISTRATION):
    return compare(reference, candidate, settings).candidates[0].metrics


def json_metrics_of(reference, candidate, settings=NO_REGISTRATION):
    """Return the metrics as in comparison.json, without the positions of the worst points."""
    values = document(compare(reference, candidate, settings))["candidates"][0]["metrics"]
    del values["hausdorff"]["worst_point"]
    return dict(flatten(values))


def flatten(value, path=""):
    """Return each number of nested JSON values by its path."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from flatten(item, f"{path}/{key}")
    elif isinstance(value, list | tuple):
        for number, item in enumerate(value):
            yield from flatten(item, f"{path}/{number}")
    else:
        yield path, value


@pytest.fixture(scope="module")
def pair():
    rng = np.random.default_rng(0)
    reference, candidate = shapes.terrain(900, seed=1)[0], shapes.terrain(500, seed=2)[0]
    return reference, candidate + rng.normal(0, 0.05, candidate.shape)


def test_shifted_plane_in_closed_form():
    plane = shapes.plane_grid(20)
    m = metrics_of(plane, plane + [0, 0, 0.25])
    for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
        assert m.d1_mse[direction].value == m.d2_mse[direction].value == 0.0625
        assert m.d1_rms[direction].value == 0.25
        assert m.hausdorff[direction].largest == m.mean_distance[direction].value == 0.25
        assert m.d1_mse[direction].floor == 1.0  # the grid's spacing
        assert m.d1_mse[direction].interval == pytest.approx([0.0625, 0.0625])
        assert m.d1_mse[direction].area_weighted == pytest.approx(0.0625)
    assert m.chamfer.sum_unsquared.value == 0.5
    assert m.chamfer.sum_squared.value == 0.125
    assert [row.threshold for row in m.fscores] == [1.0, 2.0, 5.0]


def test_deviation_of_the_shifted_plane_is_signed_upwards():
    plane = shapes.plane_grid(20)
    for shift in (0.25, -0.25):
        deviation = compare(plane, plane + [0, 0, shift], NO_REGISTRATION).candidates[0].deviation
        np.testing.assert_allclose(deviation.scalars["plane_distance"], shift)
        np.testing.assert_allclose(deviation.scalars["distance"], 0.25)


def facade(n, seed):
    """Sample a wall in the plane y = 0 with a noise of 1 cm along its normal."""
    rng = np.random.default_rng(seed)
    return np.c_[rng.uniform(0, 10, n), rng.normal(0, 0.01, n), rng.uniform(0, 6, n)]


def test_a_facade_without_normals_has_an_arbitrary_sign(tmp_path):
    reference, shift = facade(1500, seed=1), np.array([0.0, 0.05, 0.0])
    candidates = {"a": facade(1000, seed=2) + shift, "b": facade(1000, seed=3) + shift}
    comparison = compare(reference, candidates, NO_REGISTRATION)
    (notice,) = comparison.reference.warnings
    assert notice.code == "arbitrary-sign"
    check_text(notice.text)
    assert warnings(comparison).count(notice.text) == 1  # not once per candidate
    assert document(comparison)["reference"]["warnings"] == [notice.text]
    assert abs(comparison["a"].deviation.spreads["plane_distance"].median) < 0.05

    outwards = Cloud(reference, normals=np.tile([0.0, 1.0, 0.0], (len(reference), 1)))
    oriented = compare(outwards, candidates, NO_REGISTRATION)
    assert oriented.reference.warnings == ()
    assert oriented["a"].deviation.spreads["plane_distance"].bias == pytest.approx(0.05, abs=0.002)


@pytest.mark.parametrize(("scene", "warns"), [("city", False), ("terrain", False), ("facade on terrain", True)])
def test_the_sign_is_arbitrary_on_mostly_vertical_surfaces_only(scene, warns):
    ground = shapes.terrain(2000, seed=1)[0]
    reference = {
        "city": shapes.city(4000, noise=0.01, seed=1)[0],
        "terrain": ground,
        "facade on terrain": np.concatenate([ground, facade(3000, seed=1) + [50.0, 0.0, 0.0]]),
    }[scene]
    found = compare(reference, reference[::2] + 0.01, NO_REGISTRATION).reference.warnings
    assert [notice.code for notice in found] == ["arbitrary-sign"] * warns


def test_the_sign_is_judged_inside_the_region():
    points = np.concatenate([shapes.terrain(2000, seed=1)[0], facade(3000, seed=1) + [50.0, 0.0, 0.0]])
    ground = replace(NO_REGISTRATION, crop=Box([0.0, 0.0, -50.0], [40.0, 40.0, 50.0]))
    assert compare(points, points[::2], ground).reference.warnings == ()


def test_every_metric_equals_brute_force(pair):
    reference, candidate = pair
    m = metrics_of(reference, candidate, Settings(register="none", thresholds=(0.5, 1.0)))
    normals = oracles.normals(reference, 20)
    assert m.d1_mse[CANDIDATE_TO_REFERENCE].value == pytest.approx(oracles.d1(candidate, reference), rel=1e-12)
    assert m.d1_mse[REFERENCE_TO_CANDIDATE].value == pytest.approx(oracles.d1(reference, candidate), rel=1e-12)
    # 1e-9: normals of noisy patches agree to about 1e-8 degrees.
    assert m.d2_mse[CANDIDATE_TO_REFERENCE].value == pytest.approx(oracles.d2(candidate, reference, normals), rel=1e-9)
    _, closest = oracles.nearest(reference, candidate)
    plane_distances = ((reference - candidate[closest]) * normals).sum(axis=1)
    assert m.d2_mse[REFERENCE_TO_CANDIDATE].value == pytest.approx(np.mean(plane_distances**2), rel=1e-9)
    assert m.hausdorff.symmetric_max == pytest.approx(oracles.hausdorff(reference, candidate), rel=1e-12)
    assert m.chamfer.sum_unsquared.value == pytest.approx(oracles.chamfer_unsquared(reference, candidate), rel=1e-12)
    assert m.chamfer.sum_squared.value == pytest.approx(oracles.chamfer_squared(reference, candidate), rel=1e-12)
    for row in m.fscores:
        scores = (row.precision.value, row.recall.value, row.fscore.value)
        assert scores == pytest.approx(oracles.fscore(candidate, reference, row.threshold))
    floors = oracles.floor_distances(candidate, reference), oracles.floor_distances(reference, candidate)
    assert m.d1_mse[CANDIDATE_TO_REFERENCE].floor == pytest.approx(np.mean(floors[0] ** 2), rel=1e-12)
    assert m.mean_distance[CANDIDATE_TO_REFERENCE].floor == pytest.approx(np.mean(floors[0]), rel=1e-12)
    assert m.d1_mse[REFERENCE_TO_CANDIDATE].floor == pytest.approx(
        np.mean(floors[1] ** 2), rel=0.05
    )  # the candidate's noise is subtracted
    worst_point = np.array(m.hausdorff[REFERENCE_TO_CANDIDATE].worst_point)
    assert oracles.nearest(worst_point[None], candidate)[0][0] == pytest.approx(
        m.hausdorff[REFERENCE_TO_CANDIDATE].largest, rel=1e-9
    )


def test_area_weighting_equals_brute_force(pair):
    reference, candidate = pair
    comparison = compare(reference, candidate, NO_REGISTRATION)
    distances, _ = oracles.nearest(candidate, reference)
    side, origin = comparison.reference.voxel_side, np.floor(0.5 * (reference.min(axis=0) + reference.max(axis=0)))
    lower = (reference - origin).min(axis=0)
    expected = oracles.voxel_mean(distances**2, candidate - origin, side, lower)
    assert comparison.candidates[0].metrics.d1_mse[CANDIDATE_TO_REFERENCE].area_weighted == pytest.approx(
        expected, rel=1e-12
    )


@pytest.mark.parametrize("register", ["none", "icp"])
def test_a_utm_offset_changes_no_metric(pair, register):
    reference, candidate = map(round_to_grid, pair)
    settings = Settings(register=register, crop="quantile:0.9")
    values = json_metrics_of(reference, candidate, settings)
    shifted_values = json_metrics_of(reference + UTM, candidate + UTM, settings)
    assert values.keys() == shifted_values.keys()
    for path, value in values.items():
        assert shifted_values[path] == (None if value is None else pytest.approx(value, rel=1e-9)), path


def test_swapping_the_clouds_swaps_the_directions(pair):
    reference, candidate = map(round_to_grid, pair)  # subtracting the local origin is exact then
    metrics, swapped_metrics = metrics_of(reference, candidate), metrics_of(candidate, reference)
    for direction, opposite in (
        (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE),
        (REFERENCE_TO_CANDIDATE, CANDIDATE_TO_REFERENCE),
    ):
        assert metrics.d1_mse[direction].value == swapped_metrics.d1_mse[opposite].value
        assert metrics.mean_distance[direction].value == swapped_metrics.mean_distance[opposite].value
        assert metrics.hausdorff[direction].largest == swapped_metrics.hausdorff[opposite].largest


def test_crop_applies_to_queries_and_not_to_searched_points():
    plane = shapes.plane_grid(21)
    shifted = plane + [0.4, 0, 0]
    m = metrics_of(plane, shifted, Settings(register="none", crop="box:4.9,-1,-1,10.1,30,1"))
    # Each point has its partner at 0.4, also at the cut; a hard crop would find 0.6 for those whose partner is outside.
    assert m.hausdorff.symmetric_max == pytest.approx(0.4)
    assert m.presets["gao2025"].hausdorff == pytest.approx(0.6)


@pytest.mark.slow
def test_intervals_of_d1_cover_the_expectation():
    """Nominal 95 % intervals of D1 contain the expectation in most of 40 scenes."""
    rng = np.random.default_rng(7)
    grid = shapes.plane_grid(60)
    covered_count = 0
    for _ in range(40):
        heights = rng.normal(0, 0.2, len(grid))
        low, high = metrics_of(grid, grid + heights[:, None] * [0, 0, 1]).d1_mse.accuracy.interval
        covered_count += low <= 0.04 <= high
    assert covered_count >= 33  # 95 % of 40 is 38; fewer than 33 has a probability below 0.003


def test_differences_between_candidates():
    grid, rng = shapes.plane_grid(40), np.random.default_rng(8)
    up = np.array([0, 0, 1.0])
    good, same, bad = (grid + rng.normal(0, s, len(grid))[:, None] * up for s in (0.1, 0.1, 0.2))
    rows = compare(grid, {"good": good, "same": same, "bad": bad}, NO_REGISTRATION).differences
    d1 = {(r.a, r.b): r for r in rows if r.metric == f"d1_mse/{CANDIDATE_TO_REFERENCE}"}
    assert len(d1) == 3
    assert d1["good", "bad"].interval.high < 0
    assert d1["good", "bad"].difference == pytest.approx(-0.03, abs=0.005)
    assert d1["good", "same"].interval.low < 0 < d1["good", "same"].interval.high


def test_errors_common_to_two_candidates_cancel_in_their_difference():
    grid, rng = shapes.plane_grid(40), np.random.default_rng(8)
    heights = rng.normal(0, 0.1, len(grid))
    a, b = (grid + (heights * factor)[:, None] * [0, 0, 1.0] for factor in (1.0, 1.01))
    result = compare(grid, {"a": a, "b": b}, NO_REGISTRATION)
    d1 = next(row for row in result.differences if row.metric == f"d1_mse/{CANDIDATE_TO_REFERENCE}")
    # The squares differ by 2 %, so the interval of their difference is about 2 % as wide as theirs.
    own, paired = (score.interval.high - score.interval.low for score in (result["a"].metrics.d1_mse.accuracy, d1))
    assert paired == pytest.approx(0.02 * own, rel=0.1)


def test_results_do_not_depend_on_other_candidates(pair):
    reference, candidate = pair
    single = document(compare(reference, {"x": candidate}, NO_REGISTRATION))
    several = document(compare(reference, {"y": candidate + 1, "x": candidate}, NO_REGISTRATION))
    assert single["candidates"][0]["metrics"] == several["candidates"][1]["metrics"]


@pytest.mark.long
def test_two_runs_and_any_number_of_threads_give_the_same_json(tmp_path):
    script = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "from pcbench.scenes.synthetic import demo\n"
        "from pcbench import compare\n"
        "from pcbench.report import document, to_json\n"
        "d = demo(60_000)\n"
        "c = document(compare(d.reference, d.candidates))\n"
        "c['provenance'] = None\n"
        "for x in c['candidates']: x['timings_s'] = x['peak_rss_bytes'] = None\n"
        "print(to_json(c))"
    )
    outputs = [
        subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "1", "2")
    ]
    assert outputs[0] == outputs[1] == outputs[2]


def test_document_keys_and_null_instead_of_nan(pair):
    reference, candidate = pair
    doc = json.loads(to_json(document(compare(reference, {"x": candidate, "copy": reference}, NO_REGISTRATION))))
    assert doc["schema"] == "pcbench.comparison/1"
    reference_keys = {"path", "points", "points_in_region", "spacing_median", "extent", "crs", "sha256"}
    assert reference_keys <= doc["reference"].keys()
    assert {"version", "commit", "seed", "machine", "command", "created"} <= doc["provenance"].keys()
    first, copy = doc["candidates"]
    assert {
        "name",
        "path",
        "points",
        "points_in_region",
        "sha256",
        "registration",
        "metrics",
        "deviation",
        "deformation",
        "timings_s",
        "peak_rss_bytes",
    } <= first.keys()
    registration = first["registration"]
    assert np.array(registration["T_reference_candidate"]).shape == (4, 4)
    assert {
        "method",
        "scale",
        "rmse",
        "overlap",
        "iterations",
        "converged",
        "information_eigenvalues",
        "weakest_sigma",
        "check_points",
        "warnings",
    } <= registration.keys()
    assert copy["metrics"]["presets"]["mpeg"]["d1_psnr"] is None
    assert {"kind", "percentiles", "rms", "bias"} <= first["deviation"].keys()


def test_two_points_have_no_normals_and_no_d2():
    m = metrics_of(np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0.5]]))
    assert m.d2_mse[CANDIDATE_TO_REFERENCE].value is None
    assert m.presets["gao2025"].d2_mse is None
    assert m.presets["mpeg"].d2_mse.symmetric is None
    assert m.d1_mse[CANDIDATE_TO_REFERENCE].value == 0.25


def test_clouds_of_one_point_each():
    m = metrics_of(np.zeros((1, 3)), np.array([[0, 0, 3.0]]))
    assert m.d1_mse[CANDIDATE_TO_REFERENCE].value == 9
    assert m.d1_mse[CANDIDATE_TO_REFERENCE].floor is None
    assert m.fscores == ()


def test_inputs_are_not_modified(pair):
    reference, candidate = (Cloud(c.copy()) for c in pair)
    compare(reference, candidate, Settings())
    np.testing.assert_array_equal(reference.points, pair[0])
    np.testing.assert_array_equal(candidate.points, pair[1])


def test_invalid_inputs_are_refused(pair, monkeypatch):
    reference, candidate = pair
    for crop in ("sphere:900,0,0,1", Sphere([900, 0, 0], 1)):
        with check_error():
            compare(reference, candidate, Settings(crop=crop))
    monkeypatch.setattr(advice, "has_global", lambda: True)  # the message does not depend on what is installed
    with check_error(RegistrationError):
        compare(reference, candidate + 1e4, NO_REGISTRATION)
    with check_error():
        compare(reference, [], NO_REGISTRATION)
    with check_error():
        Settings(thresholds=(0.0,))
    with check_error():
        compare(reference, {"x": candidate[candidate[:, 0] > 20]}, Settings("none", crop="box:0,0,-9,10,40,9"))


def test_different_coordinate_systems_are_warned_about(pair):
    reference, candidate = pair
    for candidate_crs, is_warned in (("EPSG:32618", True), ("EPSG:32617", False), (None, False)):
        clouds = Cloud(reference, crs="EPSG:32617"), Cloud(candidate, crs=candidate_crs)
        warnings = compare(*clouds, NO_REGISTRATION).candidates[0].warnings
        assert [w.code for w in warnings] == (["other-crs"] if is_warned else [])


@pytest.mark.parametrize(
    ("reference", "candidate", "command"),
    [
        ("EPSG:32617", "EPSG:32617+5703", "--crs EPSG:32617+5703"),  # the datum of some heights is not stated
        ("EPSG:32617+4979", "EPSG:32617", "--crs EPSG:32617+4979"),
        ("EPSG:32617+5703", "EPSG:32617+4979", "--to-crs EPSG:32617+5703"),
        ("EPSG:32617+5703", "EPSG:32618", "--to-crs EPSG:32617+5703"),
    ],
)
def test_the_command_against_different_heights(reference, candidate, command):
    import_or_skip("pyproj")
    from pcbench.comparison.pipeline import crs_warnings

    (warning,) = crs_warnings(reference, candidate)
    assert warning.code == "other-crs"
    assert check_text(warning.text).endswith(command)


def test_a_crs_equals_its_wkt():
    pyproj = import_or_skip("pyproj")
    from pcbench.geometry.crs import crs_name, same_crs

    wkt = pyproj.CRS.from_epsg(32617).to_wkt()
    assert same_crs("EPSG:32617", wkt)
    assert crs_name(wkt) == "EPSG:32617"
    assert not same_crs("EPSG:32617", "nonsense")


@pytest.mark.usefixtures("few_samples")
def test_a_mesh_may_be_the_reference():
    from pcbench.geometry.mesh import Mesh

    square = Mesh(np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    candidate = np.random.default_rng(1).uniform([1, 1, 0.1], [9, 9, 0.1], (500, 3))
    comparison = compare(square, candidate, NO_REGISTRATION)
    assert comparison.reference.faces == 2
    scalars = comparison.candidates[0].deviation.scalars
    np.testing.assert_allclose(scalars["mesh_distance"], 0.1, rtol=1e-12)
    np.testing.assert_allclose(scalars["plane_distance"], 0.1, rtol=1e-12)
    assert comparison.candidates[0].metrics.d2_mse[CANDIDATE_TO_REFERENCE].value == pytest.approx(0.01)


@pytest.mark.usefixtures("few_samples")
@pytest.mark.parametrize(("closed", "name"), [(True, "bias"), (False, "mean")])
def test_only_signed_distances_have_a_bias(closed, name):
    """The distances to an open mesh are never negative."""
    from pcbench.geometry.mesh import Mesh

    corners = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
    mesh = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])[: 4 if closed else 3])
    candidate = np.random.default_rng(1).uniform([1, 1, -0.1], [3, 3, 0.1], (500, 3))
    comparison = compare(mesh, candidate, NO_REGISTRATION)
    values = document(comparison)["candidates"][0]
    found = values["deviation"]["maps"]["mesh_distance"]
    assert found[name] == pytest.approx(comparison.candidates[0].deviation.scalars["mesh_distance"].mean())
    assert (found["bias"] is None) == (not closed)
    assert ("mean" in found) == (not closed)
    assert values["deviation"]["maps"]["plane_distance"]["bias"] is not None
    nearest = values["metrics"]["spreads"]["distance"][CANDIDATE_TO_REFERENCE]
    assert nearest["bias"] is None
    assert nearest["mean"] == pytest.approx(comparison.candidates[0].metrics.mean_distance.accuracy.value)
    variants = {row.variant for row in rows(comparison) if row.metric == "mesh_distance"}
    assert {"bias", "mean"} & variants == {name}


def test_a_cloud_merged_with_itself_keeps_its_spacing():
    points, _ = shapes.fibonacci_sphere(2000)
    settings = Settings(register="none", maps=("m3c2",))
    single, doubled = (compare(Cloud(p), Cloud(p + 1e-3), settings) for p in (points, np.repeat(points, 2, axis=0)))
    assert doubled.reference.spacing_median == single.reference.spacing_median > 0
    maps = [comparison.candidates[0].deviation.m3c2 for comparison in (single, doubled)]
    assert maps[0].radius == maps[1].radius > 0


def test_poses_and_methods_may_be_objects_or_texts(pair, tmp_path):
    reference, candidate = pair
    turn = Similarity.from_matrix([[0, -1, 0, 3], [1, 0, 0, 2], [0, 0, 1, 1], [0, 0, 0, 1]])
    moved = turn.inverse().apply(candidate)
    (tmp_path / "T.txt").write_text(format_matrix(turn))
    by_file = json_metrics_of(reference, moved, Settings(register=f"matrix:{tmp_path / 'T.txt'}"))
    for pose in (turn, turn.matrix, turn.matrix.tolist()):
        assert json_metrics_of(reference, moved, Settings(register=pose)) == by_file
    by_icp = compare(reference, moved, Settings(register=IcpSettings(), initial=turn))["candidate_1"].registration
    assert by_icp.method == "icp"
    np.testing.assert_allclose(by_icp.T_reference_candidate.matrix, turn.matrix, atol=0.2)  # noise and sampling
    doc = document(compare(reference, moved, Settings(register=IcpSettings(), initial=turn.matrix)))
    assert doc["settings"]["register"] == "icp"
    np.testing.assert_array_equal(doc["settings"]["initial"], turn.matrix)
    assert "initial" not in document(compare(reference, candidate, NO_REGISTRATION))["settings"]
    with check_error():
        Settings(register=np.diag([1.0, 2, 1, 1]))
    with check_error():
        Settings(register=7)


def test_access_by_name_and_iteration(pair, tmp_path):
    reference, candidate = pair
    comparison = compare(reference, {"a": candidate, "<b>": candidate + 0.01}, NO_REGISTRATION)
    assert comparison["a"] is comparison.candidates[0]
    assert [c.name for c in comparison] == ["a", "<b>"]
    assert len(comparison) == 2
    assert "a" in comparison and "c" not in comparison
    with check_error(KeyError):
        comparison["c"]
    text = repr(comparison)
    assert len(text.splitlines()) == 3
    assert f"{comparison['a'].metrics.mean_distance.accuracy.value:.4g}" in text
    page = comparison._repr_html_()
    assert page.count("<table>") == 1
    assert "&lt;b&gt;" in page
    assert "<b>" not in page.replace("<p><b>", "")  # names are escaped
    d1 = comparison["a"].metrics.d1_mse.accuracy
    assert f"{d1.value:.4g} [{d1.interval.low:.4g}, {d1.interval.high:.4g}]" in page


def test_a_comparison_of_arrays_is_saved(pair, tmp_path, monkeypatch):
    reference, candidate = pair
    comparison = compare(reference, {"a": candidate}, NO_REGISTRATION)
    comparison.save(tmp_path / "report", figures=False)
    saved = json.loads((tmp_path / "report/comparison.json").read_text())
    assert saved["candidates"] == json.loads(to_json(document(comparison)))["candidates"]
    assert saved["reference"]["path"] is None
    names = {path.name for path in (tmp_path / "report").iterdir()}
    assert {"metrics.csv", "table.md", "a_deviation.ply", "a_T.txt"} <= names
    assert "settings.json" not in names  # there are no files to read again
    monkeypatch.setattr("pcbench.report.plot.draw_if_possible", lambda folder, figures: Drawn([], "no-library"))
    with pytest.warns(UserWarning, match="no-library"):
        comparison.save(tmp_path / "without")
    assert (tmp_path / "without/comparison.json").is_file()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").touch()
    with check_error():
        comparison.save(tmp_path / "mine", figures=False)


@pytest.mark.parametrize("name", ["../b", "a/b", "", "reference"])
def test_names_that_are_no_file_names_are_not_saved(name, tmp_path):
    corners = np.eye(3)
    comparison = compare(corners, {name: corners}, NO_REGISTRATION)
    with check_error():
        comparison.save(tmp_path / "report", figures=False)
    assert not any(tmp_path.iterdir())  # no file next to the report either


def test_regions_may_be_objects_or_texts(pair):
    reference, candidate = pair
    by_text = document(compare(reference, candidate, Settings("none", crop="box:10,10,-9,25,30,9")))
    by_object = document(compare(reference, candidate, Settings("none", crop=Box([10, 10, -9], [25, 30, 9]))))
    assert by_object["candidates"][0]["metrics"] == by_text["candidates"][0]["metrics"]
    assert by_object["settings"]["crop"] == "box:10,10,-9,25,30,9"
    with check_error():
        Settings(crop=(0, 1))


def test_names_are_taken_from_any_iterable():
    settings = Settings(presets=(name for name in ("pdal",)), maps=(name for name in ("m3c2",)))
    assert (settings.presets, settings.measured_presets) == (("pdal",), ("gao2025", "mpeg", "pdal"))
    assert settings.maps == ("m3c2",)
    for value in ("pdal", None, 7):
        with check_error():
            Settings(presets=value)
