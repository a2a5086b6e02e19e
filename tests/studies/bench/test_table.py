"""The table of a bench."""

from dataclasses import replace
from functools import partial

import pytest
from benches import row, study
from wording import check_text

from pcbench.report.article import markdown
from pcbench.studies.bench.page import article
from pcbench.studies.bench.results import ThresholdScore
from pcbench.studies.bench.table import print_bench

AT_THRESHOLD = ThresholdScore(0.1, None, 0.5, 0.5, 0.5, None, None, 1.0, None, None)


def _markdown(doc):
    return markdown(article(doc))


def test_best_and_second_best_are_marked():
    measured = partial(row, points=10, threshold=0.1, accuracy_to="points", thresholds=(AT_THRESHOLD,))
    rows = [measured("a", 1.0, 0.5), measured("b", 2.0, 0.9), measured("c", 3.0, 0.7)]
    doc = study([*rows, row("d", 0.1, None, "failed", message="no")], notes=("a note",))
    table = _markdown(doc).partition("## At each threshold")[0]
    lines = {line.split("|")[1].strip(): line for line in table.splitlines() if line.startswith("|")}
    assert "**1**" in lines["a"]
    assert "_2_" in lines["b"]
    assert "**0.9**" in lines["b"]
    assert "_0.7_" in lines["c"]
    assert "*" not in lines["c"].replace("_0.7_", "")
    assert "0 of 1 ok, failed" in lines["d"]
    check_text(_markdown(doc))


def test_floors_are_in_brackets_and_each_threshold_has_a_row():
    def measured(n):
        shares = {"recall": 0.4, "recall_visible": 0.45, "fscore_visible": 0.6}
        thresholds = (
            replace(AT_THRESHOLD, pixels=1.0, precision=0.2 + 0.2 * n, **shares),
            replace(AT_THRESHOLD, threshold=0.3, precision=0.9, **{**shares, "recall_visible": None}),
        )
        means = {"mean_c2r": 0.51, "mean_c2r_floor": 0.5 + 0.02 * n, "mean_r2c": 0.7}
        return row(
            "a", 1.0, 0.5, seed=n, points=10, threshold=0.5, pixels=5.0, accuracy_to="points", precision=0.9,
            precision_floor=0.93, recall=0.4, recall_floor=0.999, thresholds=thresholds, **means,
        )  # fmt: skip

    text = _markdown(study([measured(0), measured(1), row("b", 1.0, None, "failed", message="no")]))
    first_row = next(line for line in text.splitlines() if line.startswith("| a"))
    cells = [cell.strip() for cell in first_row.split("|")]
    assert {"0.9 (0.93)", "0.4", "0.51 (0.51)", "0.7"} <= set(cells)
    assert "| a |  | 0.1 | 1 | 0.3 | 0.4 | 0.45 | 0.6 |" in text
    assert "| a |  | 0.3 | – | 0.9 | 0.4 | – | 0.6 |" in text
    assert "| b |  |" not in text.split("of seen | F of seen")[1]
    assert "at 0.5 m, 5 pixels" in check_text(text)


@pytest.mark.parametrize("columns", [None, "40", "80"])
def test_printed_table_does_not_wrap_numbers_or_words(capsys, monkeypatch, columns):
    monkeypatch.delenv("COLUMNS", raising=False)
    if columns is not None:
        monkeypatch.setenv("COLUMNS", columns)
    choices = {"image_scale": 0.125, "features": 8192, "matching": "exhaustive", "a_long_name_of_a_setting": "value"}
    measured = partial(
        row, registration="global-similarity", points=12_345_678, threshold=0.1, choices=choices, precision=0.9,
        precision_floor=0.93, recall=0.4, peak_rss_bytes=123_456_789_012,
    )  # fmt: skip
    print_bench(study([measured("a.very.long.module:Method", 1.0, 0.5), measured("b", 2.0, 0.9)]))
    header, first_row, second_row, *_ = capsys.readouterr().out.splitlines()
    assert header.split()[:3] == ["method", "settings", "runs"]
    assert first_row.split()[0] == "a.very.long.module:Method"
    assert second_row.split()[0] == "b"
    for line in (first_row, second_row):
        assert {"global-similarity", "12,345,678", "(0.93)"} <= set(line.split())
        assert "features=8192" in line and "a_long_name_of_a_setting=value" in line
