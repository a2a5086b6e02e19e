"""Reading a report for pictures; damaged reports give one line."""

import json

import numpy as np
import pytest
import shapes
from wording import check_error

from pcbench import Settings, compare
from pcbench.report.read import read_deformation, read_report


@pytest.fixture
def saved(tmp_path):
    reference, candidate = shapes.terrain(900, seed=1)[0], shapes.terrain(500, seed=2)[0]
    comparison = compare(reference, {"a": candidate, "b": candidate + 0.1}, Settings(register="none", maps=("m3c2",)))
    comparison.save(tmp_path / "report", figures=False)
    return comparison, tmp_path / "report"


def test_a_saved_report_is_read(saved):
    comparison, folder = saved
    report = read_report(folder)
    assert [candidate.name for candidate in report.candidates] == ["a", "b"]
    assert report.spacing_median == comparison.reference.spacing_median
    assert report.unit == "units of the file"
    assert report.reference() is None  # the clouds were arrays
    for found, measured in zip(report.candidates, comparison, strict=True):
        np.testing.assert_array_equal(found.deviation.points, measured.deviation.points)
        assert found.percentiles_completeness == measured.metrics.percentiles_completeness
        assert found.deformation.verdict == measured.deformation.verdict
        np.testing.assert_allclose(found.m3c2.points, measured.deviation.m3c2.cores)


@pytest.mark.parametrize("key", ["reference", "candidates"])
def test_a_damaged_report_is_one_line(saved, key):
    _, folder = saved
    document = json.loads((folder / "comparison.json").read_text())
    for value in (None, 7, [7]):
        (folder / "comparison.json").write_text(json.dumps({**document, key: value}))
        with check_error():
            read_report(folder)
    (folder / "comparison.json").write_text("{")
    with check_error():
        read_report(folder)


def test_pictures_need_no_settings(saved):
    _, folder = saved
    for text in ("{", "[]", "7"):
        (folder / "settings.json").write_text(text)
        assert read_report(folder).reference() is None


def test_a_damaged_verdict_is_one_line(tmp_path):
    for text in ("{", "[]", '{"verdict": "none"}', "7"):
        (tmp_path / "deformation.json").write_text(text)
        with check_error():
            read_deformation(tmp_path)
