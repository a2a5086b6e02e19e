"""Reading a report for pictures; damaged reports give one line."""

import json
from dataclasses import replace

import numpy as np
import pytest
import shapes
from camera_rigs import random_rotation, rotated, walk
from wording import check_error

from pcbench import Settings, compare
from pcbench.report.read import read_deformation, read_report
from pcbench.report.viewing import ViewingCameras


@pytest.fixture
def saved_report(tmp_path):
    reference, candidate = shapes.terrain(900, seed=1)[0], shapes.terrain(500, seed=2)[0]
    comparison = compare(reference, {"a": candidate, "b": candidate + 0.1}, Settings(register="none", maps=("m3c2",)))
    comparison.save(tmp_path / "report", figures=False)
    return comparison, tmp_path / "report"


def test_a_saved_report_is_read(saved_report):
    comparison, folder = saved_report
    report = read_report(folder)
    assert [candidate.name for candidate in report.candidates] == ["a", "b"]
    assert report.spacing_median == comparison.reference.spacing_median
    assert report.unit == "units of the file"
    assert report.reference() is None  # the clouds were arrays
    for read_candidate, candidate in zip(report.candidates, comparison, strict=True):
        np.testing.assert_array_equal(read_candidate.deviation.points, candidate.deviation.points)
        assert read_candidate.percentiles_completeness == candidate.metrics.percentiles_completeness
        assert read_candidate.deformation.verdict == candidate.deformation.verdict
        np.testing.assert_allclose(read_candidate.m3c2.points, candidate.deviation.m3c2.cores)


@pytest.mark.parametrize("key", ["reference", "candidates"])
def test_a_damaged_report_is_one_line(saved_report, key):
    _, folder = saved_report
    document = json.loads((folder / "comparison.json").read_text())
    for value in (None, 7, [7]):
        (folder / "comparison.json").write_text(json.dumps({**document, key: value}))
        with check_error():
            read_report(folder)
    (folder / "comparison.json").write_text("{")
    with check_error():
        read_report(folder)


def test_a_report_is_read_without_valid_settings(saved_report):
    _, folder = saved_report
    for text in ("{", "[]", "7"):
        (folder / "settings.json").write_text(text)
        assert read_report(folder).reference() is None


def test_a_damaged_verdict_is_one_line(tmp_path):
    for text in ("{", "[]", '{"verdict": "none"}', "7"):
        (tmp_path / "deformation.json").write_text(text)
        with check_error():
            read_deformation(tmp_path)


@pytest.mark.with_deformation
def test_a_report_is_read_upright_with_its_displacements(tmp_path):
    """In the upright frame of the cameras, whatever the frame of the reference, which the viewer keeps."""
    points = shapes.city(4000, seed=1)[0]
    bent = points[::2] + np.stack([np.zeros(2000), np.zeros(2000), 2e-3 * (points[::2, :2] ** 2).sum(axis=1)], axis=1)
    turn = random_rotation(8)
    cameras = ViewingCameras.of(rotated(walk(), turn))
    found = compare(points @ turn.T, {"bent": bent @ turn.T}, register="none")
    replace(found, cameras=cameras).save(tmp_path / "report", figures=False)
    plain, upright = read_report(tmp_path / "report"), read_report(tmp_path / "report", upright=True)
    assert plain.rotation is None
    np.testing.assert_allclose(plain.candidates[0].deviation.points, bent @ turn.T, atol=1e-6)
    np.testing.assert_allclose(plain.cameras.up, turn @ [0, 0, 1], atol=1e-6)
    candidate = upright.candidates[0]
    np.testing.assert_allclose(candidate.deviation.points[:, 2], bent[:, 2], atol=1e-5)
    np.testing.assert_allclose(candidate.completeness().points[:, 2], points[:, 2], atol=1e-5)
    assert upright.cameras.up == pytest.approx([0, 0, 1])
    field = candidate.field
    vectors = np.stack([field.attributes[f"displacement_{axis}"] for axis in "xyz"], axis=1)
    assert np.abs(vectors[:, 2]).mean() > 3 * np.abs(vectors[:, :2]).mean()  # the bend is vertical
