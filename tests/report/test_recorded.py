"""settings.json repeats a comparison bit for bit, in whatever form registration and region were given."""

import json

import numpy as np
import pytest
import shapes
from wording import check_error

import pcbench
from pcbench import Cloud, write_cloud
from pcbench.geometry.regions import Box, Polygon, Sphere, Union
from pcbench.geometry.transform import Similarity
from pcbench.io.json_values import to_json
from pcbench.measure.m3c2 import M3C2Settings
from pcbench.measure.settings import Settings
from pcbench.registration import ControlPoints, FeatureSettings, GivenPose, IcpSettings
from pcbench.report.document import document
from pcbench.report.folder import read_settings
from pcbench.report.recorded import record, restore

pytestmark = pytest.mark.usefixtures("without_changes")

ROTATION = np.array([[np.cos(0.001), -np.sin(0.001), 0], [np.sin(0.001), np.cos(0.001), 0], [0, 0, 1]])
# The scale has no short decimal form: a 4x4 matrix would lose its last bits.
POSE = Similarity(ROTATION, np.array([0.1, 1 / 3, -0.02]), 1.0 + 1 / 3e3)
RIGID = Similarity(ROTATION, np.array([0.1, 1 / 3, -0.02]))
POSITIONS = np.random.default_rng(7).uniform(0, 5, (6, 3))
PAIRS = {"candidate": POSITIONS, "reference": RIGID.apply(POSITIONS)}
RING = np.array([[-20.0, -20.0], [20.1, -20.0], [20.0, 20 + 1 / 3], [-20.0, 20.0]])


@pytest.fixture
def files(tmp_path):
    """Write a reference and a shifted candidate."""
    rng = np.random.default_rng(0)
    write_cloud(tmp_path / "ref.ply", Cloud(shapes.city(1500, noise=0.01, seed=1)[0], unit="m"))
    points = shapes.city(600, seed=2)[0]
    write_cloud(tmp_path / "a.ply", Cloud(points + rng.normal(0, 0.02, points.shape) + [0.05, 0.02, 0]))
    return tmp_path


def candidate_documents(comparison):
    """Return the candidates as in comparison.json, without run times."""
    candidates = json.loads(to_json(document(comparison)))["candidates"]
    for candidate in candidates:
        del candidate["timings_s"], candidate["peak_rss_bytes"]
    return candidates


@pytest.mark.parametrize(
    "settings",
    [
        {"register": IcpSettings(max_iterations=7, max_correspondence_distance=1 / 3)},
        {"register": IcpSettings(with_scale=True), "initial": POSE},
        {"register": ControlPoints(**PAIRS, names=[*"abcde", "matrix:f"], is_check=[False] * 5 + [True])},
        {"register": ControlPoints(**PAIRS, with_scale=False, text="surveyed")},
        {"register": POSE},
        {"register": GivenPose(POSE, text="by hand")},
        {"register": "none", "crop": Box(np.array([-9.0, -9, -9]), np.array([9.0, 9, 1 / 0.3]))},
        {"register": "none", "crop": Sphere(np.array([0.1, 0.2, 0.3]), 20 / 3)},
        {"register": "none", "crop": Polygon((RING, RING / 7), axis=2, lower=-1 / 3)},
        {"register": "none", "crop": Union((Polygon((RING / 3,)), Box(np.array([3.0, 3, -1]), np.array([9.0, 9, 9]))))},
        {"register": "none", "m3c2": M3C2Settings(radius=2 / 3, cores=POSITIONS)},
    ],
)
def test_a_comparison_is_repeated(files, settings):
    first = pcbench.compare(files / "ref.ply", {"a": files / "a.ply"}, thresholds=(0.1, 1 / 3), **settings)
    first.save(files / "report", figures=False)
    restored_settings, inputs = read_settings(files / "report/settings.json")
    repeated_comparison = pcbench.compare(inputs.reference.path, {"a": inputs.candidates["a"].path}, restored_settings)
    assert candidate_documents(repeated_comparison) == candidate_documents(first)
    repeated_comparison.save(files / "again", figures=False)
    assert (files / "again/settings.json").read_bytes() == (files / "report/settings.json").read_bytes()


def test_the_command_line_repeats_settings_given_as_objects(files, run):
    pose = GivenPose(POSE)
    first = pcbench.compare(files / "ref.ply", {"a": files / "a.ply"}, register=pose)
    first.save(files / "report", figures=False)
    options = ("--out", files / "two", "--no-figures", "-q")
    assert run("compare", "--settings", files / "report/settings.json", *options)[0] == 0
    registration = json.loads((files / "two/comparison.json").read_text())["candidates"][0]["registration"]
    assert registration["T_reference_candidate"] == POSE.matrix.tolist()
    assert registration["scale"] == POSE.scale


@pytest.mark.parametrize(
    "method, text",
    [
        (IcpSettings(), "icp"),
        (IcpSettings(with_scale=True), "similarity"),
        (FeatureSettings(), "global"),
        (FeatureSettings(with_scale=True), "global-similarity"),
    ],
)
def test_a_method_with_a_name_is_recorded_by_its_name(method, text):
    values = json.loads(to_json(record(Settings(register=method))))
    assert values["register"] == text
    assert restore({**values, "register": text}).register == text


def test_the_test_for_deformation_is_recorded_only_if_it_is_left_out():
    assert "deformation" not in record(Settings()).keys() | Settings().plain().keys()
    untested = record(Settings(deformation=False))
    assert untested["deformation"] is False  # and therefore in the key of a workspace
    assert not restore(untested).deformation
    with check_error():
        Settings(deformation="no")


def test_files_are_recorded_by_their_absolute_paths(files, monkeypatch):
    monkeypatch.chdir(files)
    np.savetxt("T.txt", RIGID.matrix, fmt="%.17g")
    for method in ("matrix:T.txt", GivenPose.read("T.txt")):
        settings = Settings(register=method).with_files_read()
        assert record(settings)["register"] == f"matrix:{files}/T.txt"
        np.testing.assert_array_equal(settings.register.T_reference_candidate.rotation, RIGID.rotation)


@pytest.mark.parametrize("value", [{"type": "Settings"}, {"type": "Box"}, {"type": 3}, {"type": "IcpSettings", "x": 1}])
def test_damaged_objects_are_one_line(files, run, value):
    pcbench.compare(files / "ref.ply", {"a": files / "a.ply"}, register="none").save(files / "one", figures=False)
    values = json.loads((files / "one/settings.json").read_text())
    values["settings"]["crop"] = value
    (files / "bad.json").write_text(json.dumps(values))
    code, _, err = run("compare", "--settings", files / "bad.json")
    assert code == 2
    assert len(err.splitlines()) == 1
