"""Results of the stress study: intervals, tallies, and the document."""

import math
from dataclasses import replace

import pytest
from wording import check_error

from pcbench.io.json_values import to_json
from pcbench.studies.frame.rates import Rate
from pcbench.studies.stress.descriptions import LadderInfo, MethodInfo, MissingMethod, SceneInfo
from pcbench.studies.stress.limits import Tally
from pcbench.studies.stress.metrics import MetricCell
from pcbench.studies.stress.registration import PRESETS, REGISTRATION, RegistrationCell
from pcbench.studies.stress.results import KIND, SilentFailure, StressSettings, StressStudy
from pcbench.studies.stress.subject import CRASH, FALSE_ALARM, GLOBAL, LOCAL, RIGHT, SAID, SILENT, WRONG, Group
from pcbench.studies.stress.subjects import PAIR_SUBJECTS
from pcbench.studies.stress.verdicts import VERDICTS, VerdictCell


def pose_cell(outcome, level=0.0, method="icp", **values):
    return RegistrationCell("city", "overlap", level, None, method, 0, outcome, **values)


def study():
    poses = (
        pose_cell(RIGHT, 100.0, error=0.001, error_rms=0.1, tolerance=0.5, start_error=0.2, cpu_s=1.5, warned=True),
        pose_cell(SILENT, 20.0, error=1.1, error_rms=50.0, tolerance=0.5, start_error=0.2, codes=("low-overlap",)),
        pose_cell(CRASH, 20.0, method="peer", message="SIGSEGV"),
    )
    verdict = VerdictCell(
        "city", "overlap", 20.0, None, "deform", 0, WRONG, failure="missed", verdict="none", true_rms=0.2, noise=0.04
    )
    metric = MetricCell(
        "city",
        "overlap",
        20.0,
        None,
        "pcbench",
        0,
        SAID,
        metric="mean distance",
        value=0.4,
        exact=0.1,
        floor=0.3,
        interval=(0.38, 0.42),
    )
    return StressStudy(
        settings=StressSettings(quick=True, methods=("icp",)),
        scenes=(SceneInfo("city", 150.0, 0.8, None, "m", (8000, 4000)),),
        ladders=(LadderInfo("overlap", "overlap", "parts", tuple(PAIR_SUBJECTS), "%", (100.0, 20.0)),),
        methods=(
            MethodInfo("peer", "registration", GLOBAL, "open3d", "0.19"),
            MethodInfo("icp", "registration", LOCAL, "pcbench", "1"),
            MethodInfo("pcbench", "metrics", "", "pcbench", "1"),
            MethodInfo("deform", "verdicts", "", "pcbench", "1"),
        ),
        missing=(MissingMethod("robust ICP", "not installed"),),
        registrations=poses,
        metrics=(metric,),
        verdicts=(verdict,),
        worst=(SilentFailure(poses[1], "worst_1.npz"),),
        sentences=("icp fails.",),
        provenance={"seed": 0},
    )


# Wilson 1927; values of scipy.stats.binomtest(k, n).proportion_ci(method="wilson").
@pytest.mark.parametrize(
    "count, total, low, high",
    [(1, 10, 0.017876, 0.404150), (0, 500, 0.0, 0.007624), (9, 10, 0.595850, 0.982124), (3, 3, 0.438503, 1.0)],
)
def test_wilson_intervals(count, total, low, high):
    assert Rate(count, total).interval == pytest.approx((low, high), abs=1e-6)
    assert Rate(count, total).share == count / total


def test_rate_without_runs_is_unknown():
    assert math.isnan(Rate(0, 0).share) and Rate(0, 0).interval == (0.0, 1.0)


def test_tally_counts_outcomes_and_costs():
    cells = [pose_cell(RIGHT, cpu_s=1.0, memory_bytes=5), pose_cell(FALSE_ALARM, cpu_s=3.0), pose_cell(SILENT)]
    tally = Tally.of(cells)
    assert tally.counts == {RIGHT: 1, FALSE_ALARM: 1, SILENT: 1} and tally.total == 3
    assert (tally.cpu_s, tally.memory_bytes) == (2.0, 5)
    assert tally.of_groups(REGISTRATION, Group.SUCCESS) == Rate(2, 3) and tally.rate(SAID) == Rate(0, 3)


def test_cells_know_their_criteria():
    right = pose_cell(RIGHT, error_rms=0.5, tolerance=0.5, offset_error=1.9, angle_error_deg=1.0)
    assert right.pose_is_right and [right.meets(preset) for preset in PRESETS] == [False, True, False]
    assert not pose_cell(SAID).pose_is_right and not pose_cell(SAID).meets(PRESETS[0])
    metric = study().metrics[0]
    assert metric.covers is None  # the floor is most of the value
    assert replace(metric, floor=0.1).covers is False and replace(metric, floor=None, exact=0.4).covers is True
    verdict = study().verdicts[0]
    assert verdict.size_in_noise == pytest.approx(5) and verdict.ratio is None and verdict.covers is None
    assert verdict.is_deformed


def test_levels_are_named_with_their_unit():
    info = LadderInfo("x", "x", "start", ("registration",), "deg", (5.0, 30.0))
    assert info.level_text(30.0) == "30 deg" and not info.is_list and not info.is_map


def test_study_returns_its_cells_in_groups():
    found = study()
    assert [method.name for method in found.methods_of(REGISTRATION)] == ["icp", "peer"]
    assert [ladder.name for ladder in found.ladders_of(VERDICTS)] == ["overlap"]
    assert [subject.name for subject in found.subjects()] == ["registration", "metrics", "verdicts"]
    assert found.ladder("overlap").unit == "%"


def test_document_is_read_back(tmp_path):
    (tmp_path / "stress.json").write_text(to_json(KIND.values(study())))
    found = KIND.read(tmp_path)
    assert to_json(KIND.values(found)) == to_json(KIND.values(study()))
    assert math.isnan(found.registrations[2].tolerance) and found.registrations[:2] == study().registrations[:2]
    assert found.scenes == study().scenes and found.settings == study().settings


@pytest.mark.parametrize("text", ['{"schema": "pcbench.bench/1"}', '{"schema": "pcbench.stress/1"}', "[]"])
def test_other_documents_are_refused(text, tmp_path):
    (tmp_path / "stress.json").write_text(text)
    with check_error():
        KIND.read(tmp_path)
