"""Tables of the stress study."""

import pytest
from stress_studies import study

from pcbench.studies.frame.tables import text_table
from pcbench.studies.stress.descriptions import SceneInfo
from pcbench.studies.stress.metrics import METRICS
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.subjects import PAIR_SUBJECTS
from pcbench.studies.stress.table import limits_table, outcome_table, preset_table, stress_table


def test_limits_show_the_last_safe_level_and_confident_errors():
    assert limits_table(study(), REGISTRATION) == [
        ["", "icp", "global", "peer"],
        ["rotation of the start [deg]", "15 !1", "", "15 !5"],
        ["rotation of the start [deg], offset of the start [% of the extent]", "20, 5", "", "20, 5"],
        ["overlap [%]", "60", "60", "60"],
        ["Gaussian noise [spacings]", "all", "all", "all"],
        ["degenerate surface", "75 % right or said !1", "", "75 % right or said !1"],
    ]
    assert limits_table(study(), METRICS)[1] == ["Gaussian noise [spacings]", "1 !1", "none !8"]


def test_outcomes_are_shares_of_the_runs_with_time_and_memory():
    head, icp, *_ = outcome_table(study(), REGISTRATION)
    assert dict(zip(head, icp, strict=True)) == {
        "": "icp", "runs": "49", "right": "55", "false-alarm": "2", "refused": "4.1", "said": "33",
        "silent": "4.1 % [1.1, 14]", "crash": "0", "time-out": "2", "CPU s": "0.6", "MiB": "50",
    }  # fmt: skip


def test_recall_by_the_criteria_of_benchmarks():
    head, icp, *_ = preset_table(study())
    assert head[3:] == ["indoor: 0.3 m, 15 deg", "outdoor: 2 m, 5 deg", "ETH: 0.3 m, 2 deg"]
    assert icp == ["icp", "49", *["57 % [43, 70]"] * 4]
    feet = study(scenes=(SceneInfo("city", 600.0, 1.5, 0.1, "ft", (1, 1)),))
    assert preset_table(feet) == []


def test_the_printed_tables_are_aligned():
    lines = stress_table(study()).splitlines()
    head = next(line for line in lines if line.startswith("registration: outcomes"))
    icp = next(line for line in lines if line.startswith("icp"))
    assert head.index("runs") + len("runs") == icp.index("49") + len("49")
    for subject in PAIR_SUBJECTS:
        assert any(line.startswith(f"{subject}: safe up to") for line in lines)


def test_subjects_without_cells_have_no_table():
    text = stress_table(study(metrics=(), verdicts=()))
    assert "metrics:" not in text
    assert "verdicts:" not in text


@pytest.mark.parametrize("cell", ["x", "漢字", ""])
def test_text_tables_align_by_the_width_of_letters(cell):
    first, second = text_table([["name", "1"], [cell, "22"]]).splitlines()
    assert first == "name   1"
    assert second.startswith(cell)
    assert second.endswith(" 22")
