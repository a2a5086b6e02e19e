"""The table of a bench."""

from benches import row

from pcbench.studies.bench.pareto import mark_front
from pcbench.studies.bench.table import bench_markdown


def test_best_and_second_are_marked():
    rows = [row("a", 1.0, 0.5), row("b", 2.0, 0.9), row("c", 3.0, 0.7), row("d", 0.1, None, "failed", message="no")]
    for r in rows:
        r |= {"registration": "none", "points": 10, "threshold": 0.1}
    mark_front(rows)
    doc = {
        "scene": {"path": "s"},
        "reference": {"path": "r", "unit": "m", "visible_share": None, "visibility": ""},
        "rows": rows,
        "notes": ["a note"],
    }
    lines = {line.split("|")[1].strip(): line for line in bench_markdown(doc).splitlines() if line.startswith("|")}
    assert "**1**" in lines["a"]
    assert "_2_" in lines["b"]
    assert "**0.9**" in lines["b"]
    assert "_0.7_" in lines["c"]
    assert "*" not in lines["c"].replace("_0.7_", "")
    assert "0 of 1 ok, failed" in lines["d"]
    assert "d, seed 0: failed: no" in bench_markdown(doc)
