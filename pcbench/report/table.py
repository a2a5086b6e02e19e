"""The one table: metrics down, candidates across, both directions; for the terminal, for Markdown, for notebooks and as
tidy rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from html import escape
from typing import NamedTuple

from pcbench.deformation import Deformation
from pcbench.measure.deviation import Spread
from pcbench.measure.directions import MEAN_METRICS, MeanMetric
from pcbench.measure.intervals import Interval
from pcbench.measure.metrics import FScore
from pcbench.measure.presets import BothWays, Preset
from pcbench.measure.results import ARROWS, BACK, FORTH, Candidate, Difference, Estimate
from pcbench.report.comparison import Comparison

_LABELS = {
    "sum_unsquared": "Chamfer, sum of means",
    "sum_squared": "Chamfer, sum of mean squares",
    **{metric.name: metric.label for metric in MEAN_METRICS},
}
_WAYS = {FORTH: "accuracy", BACK: "completeness"}
_LEGEND = (
    "c→r: candidate to reference (accuracy); r→c: reference to candidate (completeness). Lengths in {unit}, squares in"
    " its square, [95 % interval]. The sampling floor is what independent, error-free points of the same surface"
    " would score: a value near it says nothing about the surface."
)


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


def rows(comparison: Comparison) -> Iterator[Row]:
    """Every number of a comparison, tidy."""
    unit = comparison.reference.unit or "unit"
    for candidate in comparison.candidates:
        yield from _candidate_rows(candidate, unit)
        yield from _deformation_rows(candidate.name, candidate.deformation, unit)


def _candidate_rows(candidate: Candidate, unit: str) -> Iterator[Row]:
    name, m = candidate.name, candidate.metrics
    units = {0: "1", 1: unit, 2: f"{unit}^2"}
    for metric in MEAN_METRICS:
        yield from _mean_rows(name, candidate, metric, units)
    for way in (FORTH, BACK):
        yield Row(name, "hausdorff", way, "largest distance to the nearest point", m.hausdorff[way].largest, unit)
    largest = m.hausdorff.symmetric_max
    yield Row(name, "hausdorff", "symmetric_max", "largest distance to the nearest point", largest, unit)
    for rank, of in (("p95", "95th percentile of the distances"), ("p99", "99th percentile of the distances")):
        for way in (FORTH, BACK):
            yield Row(name, f"hausdorff_{rank}", way, of, getattr(m.hausdorff[way], rank), unit)
    for chamfer, estimate, text, power in (
        ("sum_unsquared", m.chamfer.sum_unsquared, "mean c→r + mean r→c", 1),
        ("sum_squared", m.chamfer.sum_squared, "mean square c→r + mean square r→c", 2),
    ):
        yield _row(name, "chamfer", "both", f"{chamfer}: {text}", estimate, units[power])
    for score in m.fscores:
        at = f"threshold {score.threshold:.6g} {unit}"
        yield _row(name, "precision", FORTH, at, score.precision, "1")
        yield _row(name, "recall", BACK, at, score.recall, "1")
        yield _row(name, "fscore", "both", at, score.fscore, "1")
    for map_name, values in candidate.deviation.maps.items():
        spread = Spread.of(values)
        for key, number in (("bias", spread.bias), ("rms", spread.rms)):
            yield Row(name, map_name, FORTH, f"{key} of the deviation map", number, unit)
    if (m3c2 := candidate.deviation.m3c2) is not None:
        for key, number, power in (
            ("bias", m3c2.spread.bias, 1),
            ("rms", m3c2.spread.rms, 1),
            ("lod95_median", m3c2.median_lod, 1),
            ("significant_share", m3c2.significant_share, 0),
        ):
            yield Row(name, f"m3c2_{key}", FORTH, "M3C2 at the core points", number, units[power])
    for preset, definitions in m.presets.items():
        yield from _preset_rows(name, f"preset {preset}", definitions)


def _mean_rows(name: str, candidate: Candidate, metric: MeanMetric, units: dict[int, str]) -> Iterator[Row]:
    found, text, unit = candidate.metrics.directed[metric.name], metric.definition, units[metric.power]
    ways = {FORTH: found.accuracy, BACK: found.completeness}
    larger = {} if found.symmetric_max is None else {"symmetric_max": found.symmetric_max}
    for way, estimate in (ways | larger).items():
        yield _row(name, metric.name, way, text, estimate, unit)
    for way, estimate in ways.items():
        yield Row(name, f"{metric.name}_floor", way, f"sampling floor of: {text}", estimate.floor, unit)
        definition = f"mean over voxels of: {text}"
        yield Row(name, f"{metric.name}_area_weighted", way, definition, estimate.area_weighted, unit)
    if metric.root_name is not None:
        for way in ways:
            yield Row(name, metric.root_name, way, f"root {text}", found.root()[way].value, units[metric.power // 2])


def _row(name: str, metric: str, way: str, definition: str, estimate: Estimate, unit: str) -> Row:
    return Row(name, metric, way, definition, estimate.value, unit, *(estimate.interval or (None, None)))


def _deformation_rows(name: str, bend: Deformation, unit: str) -> Iterator[Row]:
    verdict = f"verdict: {bend.verdict}"
    if size := bend.amplitude:
        text = f"along the normals, beyond affine; {verdict}"
        yield Row(name, "deformation_rms", "", text, size.rms, unit, *size.ci)
        yield Row(name, "deformation_max", "", text, size.max, unit)
    text = f"dome found in 80 % of all cases at 1 % false alarms; {verdict}"
    yield Row(name, "minimum_detectable_rms", "", text, bend.minimum_detectable_rms, unit)


def _preset_rows(name: str, definition: str, preset: Preset) -> Iterator[Row]:
    for metric, value in _parts(preset):
        if isinstance(value, BothWays):
            for direction, number in asdict(value).items():
                yield Row(name, metric, direction, definition, number, "")
        elif isinstance(value, tuple):
            for score in value:
                at = f"{definition}, threshold {score.threshold:.6g}"
                for key in ("precision", "recall", "fscore"):
                    yield Row(name, key, "both", at, getattr(score, key), "")
        else:
            yield Row(name, metric, "", definition, value, "")


def _parts(preset: Preset) -> Iterator[tuple[str, float | BothWays | tuple[FScore, ...] | None]]:
    yield from vars(preset).items()


class _Line(NamedTuple):
    """One row of the table: a label, and a text (or one a direction) for each candidate."""

    label: str
    cells: list[tuple[str, str]]  # (c→r, r→c); the second is empty where one number stands for both


def _lines(comparison: Comparison, *, full: bool) -> Iterator[_Line | None]:
    """The table's rows; None stands for a rule. `full` adds intervals and what the terminal has no room for."""
    candidates = comparison.candidates
    registered = [c.registration for c in candidates]
    yield _Line("points", [(f"{c.points:,}", "") for c in candidates])
    yield _Line("points in region", [(f"{c.points_in_region:,}", "") for c in candidates])
    yield _Line("registration", [(r.method.partition(":")[0], "") for r in registered])
    yield _Line("  rmse, overlap", [(_number(r.rmse), f"{r.overlap:.1%}") for r in registered])
    yield None
    for metric in MEAN_METRICS:
        yield from _mean_lines(candidates, metric, full=full)
    for label, key in (
        ("Hausdorff (maximum)", "largest"),
        ("  99th percentile", "p99"),
        ("  95th percentile", "p95"),
    ):
        found = [c.metrics.hausdorff for c in candidates]
        yield _Line(label, [(_number(getattr(h[FORTH], key)), _number(getattr(h[BACK], key))) for h in found])
    yield None
    for key in ("sum_unsquared", "sum_squared"):
        chamfer: list[Estimate] = [getattr(c.metrics.chamfer, key) for c in candidates]
        yield _Line(_LABELS[key], [(_number(e.value, e.interval if full else None), "") for e in chamfer])
    for scores in zip(*(c.metrics.fscores for c in candidates), strict=True):
        cells = [(_number(s.fscore.value, s.fscore.interval if full else None), "") for s in scores]
        yield _Line(f"F-score at {_number(scores[0].threshold)}", cells)
        cells = [(_number(s.precision.value), _number(s.recall.value)) for s in scores]
        yield _Line("  precision, recall", cells)
    for preset in candidates[0].metrics.presets:
        yield None
        yield from _preset_lines(preset, [c.metrics.presets[preset] for c in candidates])
    yield None
    for name in candidates[0].deviation.maps:
        spreads = [Spread.of(c.deviation.maps[name]) for c in candidates]
        label = f"map {name.replace('_distance', '')}: bias, rms"
        yield _Line(label, [(_number(s.bias), _number(s.rms)) for s in spreads])
    yield from _bend_lines(candidates)
    along_normals = [c.deviation.m3c2 for c in candidates if c.deviation.m3c2 is not None]
    if len(along_normals) == len(candidates):
        spreads = [found.spread for found in along_normals]
        yield _Line("map m3c2: bias, rms", [(_number(s.bias), _number(s.rms)) for s in spreads])
        cells = [(_number(found.median_lod), _number(found.significant_share)) for found in along_normals]
        yield _Line("  median LoD95, significant", cells)


def _mean_lines(candidates: Sequence[Candidate], metric: MeanMetric, *, full: bool) -> Iterator[_Line]:
    found = [c.metrics.directed[metric.name] for c in candidates]
    both = [(d.accuracy, d.completeness) for d in found]
    texts = [[_number(e.value, e.interval if full else None) for e in pair] for pair in both]
    yield _Line(metric.label, [(forth, back) for forth, back in texts])
    yield _Line("  sampling floor", [(_number(a.floor), _number(b.floor)) for a, b in both])
    if metric.root_label is not None:  # a mean square: its root is what people imagine
        yield _Line("  area-weighted", [(_number(a.area_weighted), _number(b.area_weighted)) for a, b in both])
        roots = [d.root() for d in found]
        yield _Line(metric.root_label, [(_number(d.accuracy.value), _number(d.completeness.value)) for d in roots])


def _preset_lines(name: str, presets: Sequence[Preset]) -> Iterator[_Line]:
    for key, first in _parts(presets[0]):
        values = [getattr(preset, key) for preset in presets]
        if isinstance(first, BothWays):  # its a is the reference: b to a is our candidate to reference
            yield _Line(f"{name}: {key}", [(_number(v.b_to_a), _number(v.a_to_b)) for v in values])
        elif isinstance(first, tuple):
            for number, score in enumerate(first):
                label = f"{name}: F-score at {_number(score.threshold)}"
                yield _Line(label, [(_number(v[number].fscore), "") for v in values])
        else:
            yield _Line(f"{name}: {key}", [(_number(v), "") for v in values])


def _bend_lines(candidates: Sequence[Candidate]) -> Iterator[_Line]:
    bends = [c.deformation for c in candidates]
    yield _Line("deformation", [(b.verdict, "") for b in bends])
    sizes = [None if b.amplitude is None else b.amplitude.rms for b in bends]
    cells = [(_number(size), _number(b.minimum_detectable_rms)) for size, b in zip(sizes, bends, strict=True)]
    yield _Line("  bend RMS, detectable", cells)


def print_table(comparison: Comparison) -> None:
    """The table on the terminal, followed by warnings and by which candidate is better."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    # Wider than a narrow terminal rather than cut; names are data, not markup.
    console = Console(markup=False, emoji=False, highlight=False)
    console.width = max(console.width, 34 + 24 * len(comparison))
    console.print(_title(comparison), style="bold", soft_wrap=True)
    table = Table(box=None, padding=(0, 1), pad_edge=False)
    table.add_column("", no_wrap=True)
    for candidate in comparison:
        table.add_column(Text(f"{candidate.name}\nc→r"), justify="right", overflow="fold")
        table.add_column("\nr→c", justify="right", overflow="fold")
    for line in _lines(comparison, full=False):
        if line is None:
            table.add_section()
            table.add_row("")
            continue
        style = "dim" if line.label.startswith("  ") else ""
        table.add_row(line.label, *(text for cell in line.cells for text in cell), style=style)
    console.print(table)
    console.print()
    for warning in _warnings(comparison):
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True)
    for sentence in _sentences(comparison):
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


def markdown(comparison: Comparison) -> str:
    """`table.md`: the table with 95 % intervals, the definitions, warnings and differences."""
    names = [candidate.name.replace("|", "\\|") for candidate in comparison]
    header = ["", *(f"{name} {arrow}" for name in names for arrow in ARROWS.values())]
    lines = [f"# {_title(comparison)}", "", _md_row(header), _md_row(["---"] + ["---:"] * (len(header) - 1))]
    for line in _lines(comparison, full=True):
        if line is not None:
            label = f"&nbsp;&nbsp;{line.label.strip()}" if line.label.startswith("  ") else line.label
            lines.append(_md_row([label, *(text for cell in line.cells for text in cell)]))
    lines += [
        "",
        _legend(comparison),
        "",
        *(f"- warning: {' '.join(str(warning).splitlines())}" for warning in _warnings(comparison)),
        *(f"- {sentence}" for sentence in _sentences(comparison)),
    ]
    return "\n".join(lines).rstrip() + "\n"


def html(comparison: Comparison) -> str:
    """The table for a notebook, followed by warnings and sentences; names are escaped."""
    right, left = "text-align:right;padding:1px 10px", "text-align:left;padding:1px 10px"
    names = "".join(f'<th colspan="2" style="text-align:center">{escape(c.name)}</th>' for c in comparison)
    ways = "".join(
        f'<th style="{right}">{_WAYS[way]} {arrow}</th>' for _ in comparison for way, arrow in ARROWS.items()
    )
    body = []
    for line in _lines(comparison, full=False):
        if line is not None:
            is_detail = line.label.startswith("  ")
            style = f"{left};font-weight:normal;padding-left:2em;opacity:0.75" if is_detail else left
            cells = "".join(f'<td style="{right}">{escape(text)}</td>' for pair in line.cells for text in pair)
            body.append(f'<tr><th scope="row" style="{style}">{escape(line.label.strip())}</th>{cells}</tr>')
    notes = [f"warning: {warning}" for warning in _warnings(comparison)] + list(_sentences(comparison))
    return (
        f"<p><b>{escape(_title(comparison))}</b></p>"
        f"<table><thead><tr><th></th>{names}</tr><tr><th></th>{ways}</tr></thead><tbody>{''.join(body)}</tbody></table>"
        f"<ul>{''.join(f'<li>{escape(note)}</li>' for note in notes)}</ul><p>{escape(_legend(comparison))}</p>"
    )


def _sentences(comparison: Comparison) -> Iterator[str]:
    """Is a candidate deformed, and is a better than b? In words."""
    for candidate in comparison:
        yield candidate.deformation.sentence(candidate.name, comparison.reference.unit or "")
    for difference in comparison.differences:
        if difference.metric in (f"d1_mse/{FORTH}", f"d1_mse/{BACK}", f"d2_mse/{FORTH}", "chamfer/sum_squared"):
            yield _difference_words(difference)


def _difference_words(found: Difference) -> str:
    """For the metrics that most readers look at."""
    metric, _, detail = found.metric.partition("/")
    label = _LABELS.get(detail) or f"{_LABELS[metric]} {ARROWS[detail]}"
    low, high = found.interval
    if low <= 0 <= high:
        return f"{label}: {found.a} and {found.b} cannot be told apart (difference in [{low:.3g}, {high:.3g}])"
    better, worse = (found.a, found.b) if high < 0 else (found.b, found.a)
    bounds = sorted((abs(low), abs(high)))
    by = f"{abs(found.difference):.3g} [{bounds[0]:.3g}, {bounds[1]:.3g}]"
    return f"{label}: {better} is lower than {worse} by {by}"


def _warnings(comparison: Comparison) -> Iterator[str]:
    inputs = comparison.inputs
    if inputs is not None:
        yield from inputs.reference.warnings
    for candidate in comparison:
        if inputs is not None:
            yield from inputs.candidates[candidate.name].warnings
        for warning in candidate.warnings:
            yield f"{candidate.name}: {warning}"
        for warning in candidate.registration.warnings:
            yield f"{candidate.name}: {warning}"
        if candidate.deformation.verdict != "undecided":  # then its sentence holds them
            for notice in candidate.deformation.warnings:
                yield f"{candidate.name}: {notice}"


def _title(comparison: Comparison) -> str:
    reference = comparison.reference
    unit = f" {reference.unit}" if reference.unit else ""
    name = "reference" if comparison.inputs is None else " ".join(comparison.inputs.reference.path.splitlines())
    return f"{name}: {reference.points:,} points, spacing {reference.spacing_median:.3g}{unit}"


def _legend(comparison: Comparison) -> str:
    return _LEGEND.format(unit=comparison.reference.unit or "the files' unit")


def _number(value: float | None, ci: Interval | None = None) -> str:
    if value is None:
        return "–"
    text = f"{value:.4g}"
    return f"{text} [{ci.low:.4g}, {ci.high:.4g}]" if ci else text


def _md_row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"
