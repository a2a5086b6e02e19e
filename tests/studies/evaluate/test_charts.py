"""The chart of scores against time."""

import shutil

from optional import import_or_skip

from pcbench.report import to_json
from pcbench.studies.evaluate.charts import PICTURES, draw_charts, mean_times, time_chart
from pcbench.studies.evaluate.means import means_over_scenes
from pcbench.studies.evaluate.results import (
    KIND,
    EvaluateSettings,
    MethodComparison,
    PairEvaluation,
    ProtocolInfo,
    ScoreColumn,
)

ERRORS = {"slow": (1.0, 2.0), "fast": (3.0, 3.0), "worse": (4.0, 5.0), "untimed": (0.5, 0.5)}
SECONDS = {"slow": (90, 110), "fast": (10, 10), "worse": (30, None), "untimed": (None, None)}


def study(seconds=SECONDS):
    columns = (ScoreColumn("error", "m"), ScoreColumn("share", "", "higher"), ScoreColumn("points", "", None))
    pairs = tuple(
        PairEvaluation(f"s{k}", m, "ok", scores={"error": e, "share": 1 / e, "points": 9.0}, seconds=seconds[m][k])
        for m, errors in ERRORS.items()
        for k, e in enumerate(errors)
    )
    means = means_over_scenes(columns, list(ERRORS), pairs, 0)
    info = ProtocolInfo("p", "P", "", "", {})
    return MethodComparison(EvaluateSettings(), info, columns, ("s0", "s1"), tuple(ERRORS), pairs, means)


def test_each_ranked_score_has_a_panel_with_the_methods_that_have_times():
    import_or_skip("matplotlib")
    assert mean_times(study()) == {"slow": 100, "fast": 10, "worse": 30}
    panels = [axis for axis in time_chart(study()).axes if axis.get_title()]
    assert [axis.get_title() for axis in panels] == ["error [m] ↓", "share ↑"]
    *points, front = panels[0].lines
    assert [(line.get_label(), *line.get_xydata()[0]) for line in points] == [
        *(("slow", 100, 1.5), ("fast", 10, 3.0), ("worse", 30, 4.5))
    ]
    assert front.get_xydata().tolist() == [[10, 3.0], [100, 1.5]]  # `worse` is not the best for its time


def test_without_times_there_is_no_chart(tmp_path):
    assert draw_charts(study(dict.fromkeys(ERRORS, (None, None))), tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_charts_are_drawn_again(tmp_path):
    import_or_skip("matplotlib")
    (tmp_path / KIND.document).write_text(to_json(KIND.values(study())))
    (chart,) = draw_charts(study(), tmp_path)
    assert chart == tmp_path / "figures" / "time.png" and chart.stat().st_size > 5000
    shutil.rmtree(tmp_path / "figures")
    assert PICTURES.fits(tmp_path)
