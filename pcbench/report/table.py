"""The one table: metrics down, candidates across, both directions; for the terminal, for Markdown and as tidy rows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from pcbench.deformation import Deformation
from pcbench.measure.scores import BACK, FORTH

_ARROWS = {FORTH: "c→r", BACK: "r→c"}
_DIRECTED = (  # name, definition, power of the unit
    ("d1_mse", "mean square, point to nearest point", 2),
    ("d1_rms", "root mean square, point to nearest point", 1),
    ("d2_mse", "mean square, point to tangent plane of the reference", 2),
    ("d2_rms", "root mean square, point to tangent plane of the reference", 1),
    ("mean_distance", "mean distance to the nearest point", 1),
)
_LABELS = {
    "d1_mse": "D1 MSE",
    "d1_rms": "D1 RMS",
    "d2_mse": "D2 MSE",
    "d2_rms": "D2 RMS",
    "mean_distance": "mean distance",
    "sum_unsquared": "Chamfer, sum of means",
    "sum_squared": "Chamfer, sum of mean squares",
}


class Row(NamedTuple):
    """One line of metrics.csv."""

    candidate: str
    metric: str
    direction: str
    definition: str
    value: float | None
    unit: str
    ci_low: float | None = None
    ci_high: float | None = None


def rows(doc: dict[str, Any]) -> Iterator[Row]:
    """Every number of a `comparison.json` document, tidy."""
    unit = doc["reference"].get("unit") or "unit"
    for candidate in doc["candidates"]:
        yield from _candidate_rows(candidate["name"], candidate["metrics"], candidate["deviation"], unit)
        yield from _deformation_rows(candidate["name"], Deformation.from_json(candidate["deformation"]), unit)


def _candidate_rows(name: str, m: dict[str, Any], deviation: dict[str, Any], unit: str) -> Iterator[Row]:
    units = {0: "1", 1: unit, 2: f"{unit}^2"}
    none = [None, None]
    for metric, definition, power in _DIRECTED:
        values = m[metric]
        for way in (FORTH, BACK, "symmetric_max"):
            if way in values:
                ci = (values.get("ci") or {}).get(way) or none
                yield Row(name, metric, way, definition, values[way], units[power], *ci)
        for way in (FORTH, BACK):
            if "floor" in values:
                text = f"sampling floor of: {definition}"
                yield Row(name, f"{metric}_floor", way, text, values["floor"][way], units[power])
            if "area_weighted" in values:
                text = f"mean over voxels of: {definition}"
                yield Row(name, f"{metric}_area_weighted", way, text, values["area_weighted"][way], units[power])
    h = m["hausdorff"]
    for way in (FORTH, BACK, "symmetric_max"):
        yield Row(name, "hausdorff", way, "largest distance to the nearest point", h[way], unit)
    for rank in ("p95", "p99"):
        for way in (FORTH, BACK):
            yield Row(name, f"hausdorff_{rank}", way, f"{rank[1:]}th percentile of the distances", h[rank][way], unit)
    for chamfer, text, power in (
        ("sum_unsquared", "mean c→r + mean r→c", 1),
        ("sum_squared", "mean square c→r + mean square r→c", 2),
    ):
        ci = m["chamfer"]["ci"][chamfer]
        yield Row(name, "chamfer", "both", f"{chamfer}: {text}", m["chamfer"][chamfer], units[power], *ci)
    for score in m["fscore"]:
        at = f"threshold {score['threshold']:.6g} {unit}"
        for key, way in (("precision", FORTH), ("recall", BACK), ("fscore", "both")):
            yield Row(name, key, way, at, score[key], "1", *score["ci"][key])
    for map_name, values in deviation["maps"].items():
        for key in ("bias", "rms"):
            yield Row(name, map_name, FORTH, f"{key} of the deviation map", values[key], unit)
    if found := deviation["m3c2"]:
        for key, power in (("bias", 1), ("rms", 1), ("lod95_median", 1), ("significant_share", 0)):
            yield Row(name, f"m3c2_{key}", FORTH, "M3C2 at the core points", found[key], units[power])
    for preset, values in m["presets"].items():
        yield from _preset_rows(name, f"preset {preset}", values)


def _deformation_rows(name: str, bend: Deformation, unit: str) -> Iterator[Row]:
    verdict = f"verdict: {bend.verdict}"
    if size := bend.amplitude:
        text = f"along the normals, beyond affine; {verdict}"
        yield Row(name, "deformation_rms", "", text, size.rms, unit, *size.ci)
        yield Row(name, "deformation_max", "", text, size.max, unit)
    text = f"dome found in 80 % of all cases at 1 % false alarms; {verdict}"
    yield Row(name, "minimum_detectable_rms", "", text, bend.minimum_detectable_rms, unit)


def _preset_rows(name: str, definition: str, values: dict[str, Any]) -> Iterator[Row]:
    for metric, value in values.items():
        if isinstance(value, dict):
            for direction, number in value.items():
                yield Row(name, metric, direction, definition, number, "")
        elif isinstance(value, list):
            for score in value:
                at = f"{definition}, threshold {score['threshold']:.6g}"
                for key in ("precision", "recall", "fscore"):
                    yield Row(name, key, "both", at, score[key], "")
        else:
            yield Row(name, metric, "", definition, value, "")


class _Line(NamedTuple):
    """One row of the table: a label, and a text (or one a direction) for each candidate."""

    label: str
    cells: list[tuple[str, str]]  # (c→r, r→c); the second is empty where one number stands for both


def _lines(doc: dict[str, Any], *, full: bool) -> Iterator[_Line | None]:
    """The table's rows; None stands for a rule. `full` adds intervals and what the terminal has no room for."""
    candidates = doc["candidates"]

    def directed(label: str, key: str, *, ci: bool = False) -> _Line:
        cells = []
        for candidate in candidates:
            values = candidate["metrics"][key]
            bounds = values.get("ci", {}) if ci and full else {}
            cells.append((_number(values[FORTH], bounds.get(FORTH)), _number(values[BACK], bounds.get(BACK))))
        return _Line(label, cells)

    def part(label: str, key: str, inner: str) -> _Line:
        values = [candidate["metrics"][key][inner] for candidate in candidates]
        return _Line(label, [(_number(v[FORTH]), _number(v[BACK])) for v in values])

    yield _Line("points", [(f"{c['points']:,}", "") for c in candidates])
    yield _Line("points in region", [(f"{c['points_in_region']:,}", "") for c in candidates])
    registered = [c["registration"] for c in candidates]
    yield _Line("registration", [(r["method"].partition(":")[0], "") for r in registered])
    yield _Line("  rmse, overlap", [(_number(r["rmse"]), f"{r['overlap']:.1%}") for r in registered])
    yield None
    for key in ("d1", "d2"):
        yield directed(_LABELS[f"{key}_mse"], f"{key}_mse", ci=True)
        yield part("  sampling floor", f"{key}_mse", "floor")
        yield part("  area-weighted", f"{key}_mse", "area_weighted")
        yield directed(_LABELS[f"{key}_rms"], f"{key}_rms")
    yield directed("mean distance", "mean_distance", ci=True)
    yield part("  sampling floor", "mean_distance", "floor")
    yield directed("Hausdorff (maximum)", "hausdorff")
    yield part("  99th percentile", "hausdorff", "p99")
    yield part("  95th percentile", "hausdorff", "p95")
    yield None
    for key in ("sum_unsquared", "sum_squared"):
        chamfer = [c["metrics"]["chamfer"] for c in candidates]
        yield _Line(_LABELS[key], [(_number(c[key], c["ci"][key] if full else None), "") for c in chamfer])
    for number, score in enumerate(candidates[0]["metrics"]["fscore"]):
        scores = [c["metrics"]["fscore"][number] for c in candidates]
        label = f"F-score at {_number(score['threshold'])}"
        yield _Line(label, [(_number(s["fscore"], s["ci"]["fscore"] if full else None), "") for s in scores])
        yield _Line("  precision, recall", [(_number(s["precision"]), _number(s["recall"])) for s in scores])
    for preset in candidates[0]["metrics"]["presets"]:
        yield None
        values = [c["metrics"]["presets"][preset] for c in candidates]
        for key, first in values[0].items():
            if isinstance(first, dict):
                keys = [k for k in first if k != "symmetric"]
                cells = [(_number(v[key][keys[1]]), _number(v[key][keys[0]])) for v in values]
                yield _Line(f"{preset}: {key}", cells)  # mpeg's b_to_a is our candidate -> reference
            elif isinstance(first, list):
                for number, score in enumerate(first):
                    label = f"{preset}: F-score at {_number(score['threshold'])}"
                    yield _Line(label, [(_number(v[key][number]["fscore"]), "") for v in values])
            else:
                yield _Line(f"{preset}: {key}", [(_number(v[key]), "") for v in values])
    deviations = [c["deviation"] for c in candidates]
    yield None
    for name in deviations[0]["maps"]:
        maps = [d["maps"][name] for d in deviations]
        label = name.replace("_distance", "")
        yield _Line(f"map {label}: bias, rms", [(_number(m["bias"]), _number(m["rms"])) for m in maps])
    bends = [Deformation.from_json(c["deformation"]) for c in candidates]
    yield _Line("deformation", [(b.verdict, "") for b in bends])
    sizes = [None if b.amplitude is None else b.amplitude.rms for b in bends]
    cells = [(_number(size), _number(b.minimum_detectable_rms)) for size, b in zip(sizes, bends, strict=True)]
    yield _Line("  bend RMS, detectable", cells)
    if all(d["m3c2"] for d in deviations):
        found = [d["m3c2"] for d in deviations]
        yield _Line("map m3c2: bias, rms", [(_number(m["bias"]), _number(m["rms"])) for m in found])
        cells = [(_number(m["lod95_median"]), _number(m["significant_share"])) for m in found]
        yield _Line("  median LoD95, significant", cells)


def print_table(doc: dict[str, Any]) -> None:
    """The table on the terminal, followed by warnings and by which candidate is better."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    # Wider than a narrow terminal rather than cut; names are data, not markup.
    console = Console(markup=False, emoji=False, highlight=False)
    console.width = max(console.width, 34 + 24 * len(doc["candidates"]))
    console.print(_title(doc), style="bold", soft_wrap=True)
    table = Table(box=None, padding=(0, 1), pad_edge=False)
    table.add_column("", no_wrap=True)
    for candidate in doc["candidates"]:
        table.add_column(Text(f"{candidate['name']}\nc→r"), justify="right", overflow="fold")
        table.add_column("\nr→c", justify="right", overflow="fold")
    for line in _lines(doc, full=False):
        if line is None:
            table.add_section()
            table.add_row("")
            continue
        style = "dim" if line.label.startswith("  ") else ""
        table.add_row(line.label, *(text for cell in line.cells for text in cell), style=style)
    console.print(table)
    console.print()
    for warning in _warnings(doc):
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True)
    for sentence in (*bends(doc), *verdicts(doc)):
        console.print(sentence, soft_wrap=True)


def print_columns(rows: Iterable[Sequence[str]]) -> None:
    """A table on the terminal: the first row is its header, the first column its labels."""
    from rich.console import Console
    from rich.table import Table

    header, *lines = ([*row] for row in rows)
    table = Table(box=None, padding=(0, 1), pad_edge=False)
    for number, title in enumerate(header):
        table.add_column(title, no_wrap=True, justify="right" if number else "left")
    for line in lines:
        table.add_row(*line)
    console = Console(markup=False, emoji=False, highlight=False)
    # Wider than a narrow terminal rather than cut.
    widths = [max(len(line[k]) for line in [header, *lines]) for k in range(len(header))]
    console.width = max(console.width, sum(widths) + 2 * len(widths))
    console.print(table)


def markdown(doc: dict[str, Any]) -> str:
    """`table.md`: the table with 95 % intervals, the definitions, warnings and differences."""
    names = [candidate["name"].replace("|", "\\|") for candidate in doc["candidates"]]
    header = ["", *(f"{name} {arrow}" for name in names for arrow in _ARROWS.values())]
    lines = [f"# {_title(doc)}", "", _md_row(header), _md_row(["---"] + ["---:"] * (len(header) - 1))]
    for line in _lines(doc, full=True):
        if line is not None:
            label = f"&nbsp;&nbsp;{line.label.strip()}" if line.label.startswith("  ") else line.label
            lines.append(_md_row([label, *(text for cell in line.cells for text in cell)]))
    unit = doc["reference"].get("unit") or "the files' unit"
    lines += [
        "",
        f"c→r: candidate to reference (accuracy); r→c: reference to candidate (completeness). Lengths in {unit},"
        " squares in its square, [95 % interval over blocks of space]. The sampling floor is what two samples of the"
        " same surface would score: a value near it says nothing about the surface. It does not know correlated noise.",
        "",
        *(f"- warning: {warning}" for warning in _warnings(doc)),
        *(f"- {sentence}" for sentence in (*bends(doc), *verdicts(doc))),
    ]
    return "\n".join(lines).rstrip() + "\n"


def bends(doc: dict[str, Any]) -> Iterator[str]:
    """Is a candidate deformed? In words."""
    for candidate in doc["candidates"]:
        bend = Deformation.from_json(candidate["deformation"])
        yield bend.sentence(candidate["name"], doc["reference"].get("unit") or "")


def verdicts(doc: dict[str, Any]) -> Iterator[str]:
    """Is a better than b? In words, for the metrics that most readers look at."""
    shown = (
        f"d1_mse/{FORTH}",
        f"d1_mse/{BACK}",
        f"d2_mse/{FORTH}",
        "chamfer/sum_squared",
    )
    for row in doc["differences"]:
        if row["metric"] not in shown:
            continue
        metric, _, detail = row["metric"].partition("/")
        label = _LABELS.get(detail) or f"{_LABELS[metric]} {_ARROWS[detail]}"
        low, high = row["ci"]
        if low <= 0 <= high:
            yield f"{label}: {row['a']} and {row['b']} cannot be told apart (difference in [{low:.3g}, {high:.3g}])"
            continue
        better, worse = (row["a"], row["b"]) if high < 0 else (row["b"], row["a"])
        bounds = sorted((abs(low), abs(high)))
        by = f"{abs(row['difference']):.3g} [{bounds[0]:.3g}, {bounds[1]:.3g}]"
        yield f"{label}: {better} is lower than {worse} by {by}"


def _warnings(doc: dict[str, Any]) -> Iterator[str]:
    yield from doc["reference"].get("warnings", [])
    for candidate in doc["candidates"]:
        yield from candidate.get("warnings", [])
        for warning in candidate["registration"]["warnings"]:
            yield f"{candidate['name']}: {warning}"
        bend = Deformation.from_json(candidate["deformation"])
        if bend.verdict != "undecided":  # then its sentence holds them
            for notice in bend.warnings:
                yield f"{candidate['name']}: {notice}"


def _title(doc: dict[str, Any]) -> str:
    reference = doc["reference"]
    unit = f" {reference['unit']}" if reference.get("unit") else ""
    path = reference.get("path") or "reference"
    return f"{path}: {reference['points']:,} points, spacing {reference['spacing_median']:.3g}{unit}"


def _number(value: float | None, ci: list[float] | None = None) -> str:
    if value is None:
        return "–"
    text = f"{value:.4g}"
    return f"{text} [{ci[0]:.4g}, {ci[1]:.4g}]" if ci else text


def _md_row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"
