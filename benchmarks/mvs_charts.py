"""Accuracy of a dense cloud by time budget and by correlation: python benchmarks/mvs_charts.py --chart FOLDER

`pcbench bench` runs `mvs` on a synthetic city with exact truth and varies one setting at a time: `spacing`,
`image_scale` and `sources`. Then one run is filtered and fused again for each `correlation`. Prints a table; `--chart`
draws F-score against time and precision against completeness, both at two pixel footprints.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from measure import setting
from mvs_city import make_city, pcbench, reconstruct, score_workspace

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from dense_cases import read_city

SWEEPS = {"spacing": "0.55,0.7,1", "image_scale": "0.35,0.5,0.7,1", "sources": "2,4,8"}
CORRELATIONS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9)
THRESHOLD_INDEX = 1  # index of the bench's threshold of 2 pixels
LINE_STYLES = {"spacing": ("#0072b2", "o"), "image_scale": ("#d55e00", "s"), "sources": ("#009e73", "^")}
# Label positions that are clear of the lines: upper left of rising lines, lower right of the lowest rising line, and
# upper right of falling lines.
LABEL_ABOVE = ((-4, 5), "right", "bottom")
LABEL_BESIDE = {"spacing": ((4, -5), "left", "top"), "correlation": ((5, 3), "left", "bottom")}


class ChartPoint(NamedTuple):
    """A point of a chart: the value of the setting, and its position."""

    label: str
    x: float
    y: float


def measure_budgets(city: Path, out: Path) -> dict[str, list[ChartPoint]]:
    """Measure seconds and F-scores over the visible part for each value of each setting."""
    points_by_setting: dict[str, list[ChartPoint]] = {}
    for key, values in SWEEPS.items():
        folder, reference = out / key, city / "truth" / "cloud.ply"
        bench_options = ["--method", "mvs", "--sweep", f"{key}={values}", "--out", folder, "--no-figures", "--quiet"]
        pcbench("bench", city, "--reference", reference, *bench_options)
        rows = [row for row in json.loads((folder / "bench.json").read_text())["rows"] if row["status"] == "ok"]
        for row in rows:
            threshold_score = row["thresholds"][THRESHOLD_INDEX]
            points_by_setting.setdefault(key, []).append(
                ChartPoint(row["choices"][key], row["cpu_s"], threshold_score["fscore_visible"])
            )
            print(
                f"{key:12}{row['choices'][key]:>6}{row['wall_s']:8.1f}{row['cpu_s']:8.1f}{row['points']:10,}"
                f"{threshold_score['precision']:9.3f}{threshold_score['recall_visible']:9.3f}{threshold_score['fscore_visible']:9.3f}",
                flush=True,
            )
    return points_by_setting


def measure_correlations(folder: Path, work: Path) -> list[ChartPoint]:
    """Measure completeness over the visible part and precision per correlation; only filter and fusion run again."""
    city, points = read_city(folder), []
    work.mkdir(exist_ok=True)
    for correlation in CORRELATIONS:
        reconstruct(folder, work, correlation)
        score = score_workspace(city, work)
        points.append(ChartPoint(f"{correlation:g}", score.recall[THRESHOLD_INDEX], score.precision[THRESHOLD_INDEX]))
        print(
            f"{'correlation':12}{correlation:6g}{'':16}{score.points:10,}{score.precision[THRESHOLD_INDEX]:9.3f}{score.recall[THRESHOLD_INDEX]:9.3f}"
            f"{score.fscore[THRESHOLD_INDEX]:9.3f}{score.wrong:9.2%}",
            flush=True,
        )
    return points


def draw(lines: dict[str, list[ChartPoint]], path: Path, x: str, y: str) -> None:
    """Draw lines with labelled points."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.add_subplot()
    for key, points in lines.items():
        color, shape = LINE_STYLES.get(key, ("#0072b2", "o"))
        axis.plot([p.x for p in points], [p.y for p in points], f"-{shape}", color=color, alpha=0.85, label=key)
        offset, ha, va = LABEL_BESIDE.get(key, LABEL_ABOVE)
        for point in points:
            axis.annotate(
                point.label,
                (point.x, point.y),
                offset,
                textcoords="offset points",
                ha=ha,
                va=va,
                color=color,
                fontsize=9,
            )
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.margins(0.09, 0.14)
    axis.grid(True, alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, loc="best")
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--size", default="360x240")
    parser.add_argument("--rig", default="oblique")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--only", choices=("budgets", "correlation"))
    parser.add_argument("--folder", type=Path, help="Folder that keeps all files; existing ones are used again.")
    parser.add_argument("--chart", type=Path, metavar="FOLDER", help="Draw mvs_budgets.png and mvs_confidence.png.")
    options = parser.parse_args()
    print(setting())
    print(f"{options.images} images of {options.size}, rig {options.rig}, a city of 100 m, seed {options.seed}")
    print(f"{'':18}{'wall s':>8}{'CPU s':>8}{'points':>10}{'within 2':>9}{'seen':>9}{'F-score':>9}{'wrong':>9}")
    with tempfile.TemporaryDirectory() as temporary:
        root = options.folder or Path(temporary)
        root.mkdir(parents=True, exist_ok=True)
        if not (root / "city").exists():
            make_city(root / "city", "city", options, options.seed)
        threshold_label = "2 footprints"
        if options.only != "correlation":
            lines = measure_budgets(root / "city", root)
            if options.chart:
                draw(
                    lines,
                    options.chart / "mvs_budgets.png",
                    "CPU seconds",
                    f"F-score over the visible part, {threshold_label}",
                )
        if options.only != "budgets":
            line = {"correlation": measure_correlations(root / "city", root / "correlation")}
            if options.chart:
                path = options.chart / "mvs_confidence.png"
                draw(line, path, f"share of the visible part, {threshold_label}", f"precision, {threshold_label}")


if __name__ == "__main__":
    main()
