"""Charts of a bench: labels do not overlap."""

import itertools
from functools import partial

import benches
import pytest
from optional import import_or_skip

import_or_skip("matplotlib")

from pcbench.studies.bench import charts  # noqa: E402

row = partial(benches.row, peak_rss_bytes=2e8, mean_c2r=0.1, mean_r2c=0.2, precision=0.5, recall=0.4, threshold=0.1)


@pytest.fixture
def draw_chart(monkeypatch, tmp_path):
    """Function that draws a chart of rows and returns its figure."""
    from matplotlib.figure import Figure

    figures = []
    save = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, path, **options: (figures.append(figure), save(figure, path, **options))
    )

    def draw(rows, chart=charts.draw_speed):
        assert chart(benches.study(rows), tmp_path / "chart.png")
        return figures[-1]

    return draw


def failure_labels(figure):
    """Labels in the strips of failures, one list per strip."""
    return [axis.texts for axis in figure.axes if axis.get_ylabel() == "failed"]


TIMES = {
    "far apart": [1.0, 10.0, 100.0],
    "close": [5.0, 5.1, 5.4, 6.0, 6.1, 7.0, 7.5, 8.0, 8.1, 9.0, 9.5, 11.0],
    "at the end": [98.0, 99.0, 100.0, 100.0, 103.0],
}


@pytest.mark.parametrize("times", TIMES.values(), ids=TIMES)
def test_failure_labels_do_not_overlap(draw_chart, times):
    rows = [row("good", 2.0, 0.5), row("good", 60.0, 0.7, choices={"x": "1"})]
    statuses = itertools.cycle(["crashed", "failed", "timeout", "unmeasured"])
    rows += [row(f"m{n % 3}", time, None, next(statuses), seed=n) for n, time in enumerate(times)]
    figure = draw_chart(rows)
    strips = failure_labels(figure)
    assert len(strips) == 2
    for texts in strips:
        assert sum(int(text.get_text().partition("×")[2] or 1) for text in texts) == len(times)
        boxes = [text.get_window_extent() for text in texts]
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
        frame = texts[0].axes.bbox
        for box in boxes:
            assert frame.x0 - 1 <= box.x0 < box.x1 <= frame.x1 + 1
            assert frame.y0 - 1 <= box.y0 < box.y1 <= frame.y1 + 1


@pytest.mark.long
def test_overlapping_failure_crosses_are_counted(draw_chart):
    rows = [row("good", 2.0, 0.5), *(row("bad", 5.0 + 0.001 * n, None, "crashed", seed=n) for n in range(9))]
    for texts in failure_labels(draw_chart(rows)):
        assert [text.get_text() for text in texts] == ["crashed ×9"]
    three_methods = [row("good", 2.0, 0.5), *(row(f"bad{n}", 5.0, None, "crashed") for n in range(3))]
    for texts in failure_labels(draw_chart(three_methods)):
        assert [text.get_text() for text in texts] == ["crashed"] * 3  # one per method


def test_benches_without_pixel_thresholds_are_drawn(draw_chart):
    rows = [row("a", 1.0, 0.5, threshold=0.3), row("b", 2.0, 0.9, threshold=0.3)]
    figure = draw_chart(rows)
    assert figure.axes[0].get_ylabel() == "F-score at 0.3 m"
    assert failure_labels(figure) == []
