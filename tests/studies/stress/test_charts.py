"""Charts and pictures of the stress study."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from optional import import_or_skip
from stress_studies import LADDERS, MAP, crowded_study, study

import_or_skip("matplotlib")

from pcbench.errors import InputError  # noqa: E402
from pcbench.io.json_values import to_json  # noqa: E402
from pcbench.studies.stress.charts import draw_charts  # noqa: E402
from pcbench.studies.stress.curves import (  # noqa: E402
    coverage_chart,
    profile_chart,
    recall_chart,
    severity_charts,
    size_chart,
    speed_chart,
)
from pcbench.studies.stress.grids import basin_chart, matrix_chart, outcome_chart  # noqa: E402
from pcbench.studies.stress.registration import REGISTRATION  # noqa: E402
from pcbench.studies.stress.results import KIND, SilentFailure  # noqa: E402
from pcbench.studies.stress.subject import SILENT  # noqa: E402
from pcbench.studies.stress.worst import draw_worst, failure_title  # noqa: E402


def silent_failure(folder, points=3000):
    """The worst silent failure of the study, with clouds beside it."""
    rng = np.random.default_rng(0)
    reference = rng.uniform([-50, -50, 0], [50, 50, 10], (points, 3))
    np.savez(folder / "worst_1.npz", reference=reference, true=reference[::2] + 0.05, found=reference[::2] + [20, 0, 0])
    cell = next(c for c in study().registrations if c.outcome == SILENT and c.method == "icp")
    return SilentFailure(cell, "worst_1.npz")


@pytest.mark.long
def test_all_charts_and_pictures_are_written_and_former_ones_are_deleted(tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "worst_3.png").write_bytes(b"")
    files = draw_charts(study(worst=(silent_failure(tmp_path),)), tmp_path)
    assert set((tmp_path / "figures").iterdir()) == set(files)
    kinds = {
        "registration": ("start", "parts", "noise"),
        "metrics": ("noise",),
        "verdicts": ("warp",),
        "changes": ("changes",),
    }
    expected = {"recall", "basin_start-map", "profiles", "speed", "sizes", "coverage", "worst_1"}
    expected |= {f"{chart}_{subject}" for chart in ("outcomes", "matrix") for subject in kinds}
    expected |= {f"severity_{subject}_{kind}" for subject, found in kinds.items() for kind in found}
    assert {file.name for file in files} == {f"{name}.png" for name in expected}
    for file in files:
        assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_plot_draws_charts_again(run, tmp_path):
    few = study(metrics=(), verdicts=())
    (tmp_path / "stress.json").write_text(to_json(KIND.values(few)))
    code, out, err = run("plot", tmp_path, "recall.svg", "outcomes_registration")
    assert (code, err) == (0, "")
    drawn = [tmp_path / "figures" / name for name in ("recall.svg", "outcomes_registration.png")]
    assert out.splitlines() == list(map(str, drawn))
    assert all(path.stat().st_size > 5000 for path in drawn)


def test_charts_without_data_are_not_drawn(tmp_path):
    empty = study(registrations=(), metrics=(), verdicts=(), changes=())
    assert draw_charts(empty, tmp_path) == []


def test_bars_show_the_shares_of_the_outcomes():
    axis = outcome_chart(study(), REGISTRATION).axes[0]
    widths = [bar.get_width() for bar in axis.patches if abs(bar.get_y() + 0.35) < 1e-9]  # of the first row, icp
    assert sum(widths) == pytest.approx(100)
    assert widths == pytest.approx([100 * n / 49 for n in (27, 1, 2, 16, 2, 0, 1)])


def test_the_basin_map_shows_right_poses_by_angle_and_offset():
    figure = basin_chart(study(), MAP)
    shares = figure.axes[0].images[0].get_array()
    assert np.array_equal(shares, [[100, 100, 0], [100, 100, 0], [0, 0, 0]])
    assert figure.get_supxlabel() == "rotation of the start [deg]"
    assert figure.get_supylabel() == "offset of the start [% of the extent]"


def test_the_failure_matrix_shows_shares_of_failures():
    failed = np.ma.filled(matrix_chart(study(), REGISTRATION).axes[0].images[0].get_array(), np.nan)
    names = [ladder.name for ladder in study().ladders_of(REGISTRATION)]
    expected = {
        "start-rotation": 5 / 12,
        "start-map": 10 / 18,
        "overlap": 1 / 3,
        "noise-gaussian": 0.0,
        "degenerate": 0.25,
    }
    assert failed[:, 0] == pytest.approx([100 * expected[name] for name in names])
    assert np.isnan(failed[names.index("start-rotation"), 1])  # `global` did not run it


def test_recall_ends_at_the_share_of_runs_with_a_pose():
    axis = recall_chart(study()).axes[0]
    icp = next(line for line in axis.lines if line.get_label() == "icp")
    assert icp.get_ydata()[-1] == pytest.approx(100 * 46 / 49)  # 2 refused, 1 out of time
    assert icp.get_ydata()[0] == 0


def test_recall_marks_only_the_criteria_within_its_range():
    """All errors are far below the criteria: their labels would lie beside the panels, and shrink them."""
    made = study()
    small = tuple(
        replace(cell, error=1e-4, offset_error=0.01, angle_error_deg=0.005)
        for cell in made.registrations
        if cell.error is not None
    )
    figure = recall_chart(study(registrations=small))
    figure.draw_without_rendering()
    for axis in figure.axes:
        assert not axis.texts
        assert axis.get_window_extent().width > 0.25 * figure.bbox.width
    assert any(axis.texts for axis in recall_chart(made).axes)


def test_profiles_end_at_the_share_of_solved_problems():
    axis = profile_chart(study()).axes[0]
    ends = {line.get_label(): line.get_ydata()[-1] for line in axis.lines}
    assert ends == pytest.approx({"icp": 100, "peer": 100 * 27 / 28})


def severity_chart(made):
    """Success against severity under noise."""
    return dict(severity_charts(made, REGISTRATION))["noise"]


CHARTS = [coverage_chart, size_chart, speed_chart, recall_chart, profile_chart, severity_chart]


@pytest.mark.parametrize("made", [study(), crowded_study()], ids=["few methods", "many methods"])
@pytest.mark.parametrize("chart", CHARTS)
def test_titles_labels_and_legends_do_not_overlap(chart, made):
    figure = chart(made)
    figure.draw_without_rendering()
    boxes = [axis.get_tightbbox() for axis in figure.axes]  # with titles, labels and legends of panels
    boxes += [legend.get_window_extent() for legend in figure.legends]
    for a, b in itertools.combinations(boxes, 2):
        assert not a.padded(-1).overlaps(b)
    for box in boxes:
        assert figure.bbox.x0 - 1 <= box.x0 < box.x1 <= figure.bbox.x1 + 1


def test_pictures_of_silent_failures_say_what_failed(tmp_path):
    failure = silent_failure(tmp_path)
    title = "icp: rotation of the start 90 deg; city, seed 2; 90 m RMS and 54 deg off, not doubted"
    assert failure_title(study(), failure) == title
    (tmp_path / "worst_1.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match="damaged"):
        draw_worst(study(), failure, tmp_path, tmp_path / "worst_1.png")


def test_all_kinds_of_ladders_are_in_the_study():
    assert {ladder.is_map for ladder in LADDERS} == {ladder.is_list for ladder in LADDERS} == {True, False}
