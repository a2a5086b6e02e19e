"""The one table: metrics down, candidates across, both directions; as lines, Markdown, HTML and tidy rows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from html import escape
from typing import NamedTuple

from pcbench.deformation import Deformation
from pcbench.measure.deviation import Spread
from pcbench.measure.directions import MEAN_METRICS, MeanMetric
from pcbench.measure.metrics import FScore
from pcbench.measure.presets import BothWays, Preset
from pcbench.measure.results import ARROWS, BACK, FORTH, Candidate, Estimate
from pcbench.registration import SurveyResiduals
from pcbench.report.answer import answer
from pcbench.report.inputs import SourcedComparison
from pcbench.report.notes import details, survey_sentences, warnings
from pcbench.report.words import LABELS, number, title

_WAYS = {FORTH: "accuracy", BACK: "completeness"}
_SPREADS = {"median": "median", "std": "standard deviation", "nmad": "NMAD (1.4826 median |v - median v|)"}
_KINDS = {"distance": "distance to the nearest point", "plane_distance": "signed distance to the tangent plane"}
_SPREAD_OF = {"mean_distance": "distance", "d2_mse": "plane_distance"}  # whose distances a mean is of
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


def rows(comparison: SourcedComparison) -> Iterator[Row]:
    """Every number of a comparison, tidy."""
    unit = comparison.reference.unit or "unit"
    for candidate in comparison.candidates:
        yield from _candidate_rows(candidate, unit)
        yield from _deformation_rows(candidate.name, candidate.deformation, unit)
        yield from _survey_rows(candidate.name, candidate.registration.residuals, unit)


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
    for kind, both in m.spreads.items():
        for way in (FORTH, BACK):
            for key, of in _SPREADS.items():
                yield Row(name, f"{kind}_{key}", way, f"{of} of: {_KINDS[kind]}", getattr(both[way], key), unit)
    for map_name, values in candidate.deviation.maps.items():
        spread = Spread.of(values)
        for key in ("bias", "rms", *(() if map_name in m.spreads else _SPREADS)):
            yield Row(name, map_name, FORTH, f"{key} of the deviation map", getattr(spread, key), unit)
    if (m3c2 := candidate.deviation.m3c2) is not None:
        for key, number, power in (
            ("bias", m3c2.spread.bias, 1),
            ("rms", m3c2.spread.rms, 1),
            *((key, getattr(m3c2.spread, key), 1) for key in _SPREADS),
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


def _survey_rows(name: str, residuals: SurveyResiduals, unit: str) -> Iterator[Row]:
    for kind, points in (("control", residuals.control), ("check", residuals.check)):
        if (rmse := residuals.rmse(points)) is not None:
            of = f"root mean square error of {rmse.points} {kind} points"
            parts = {"3d": rmse.total, "horizontal": rmse.horizontal, "vertical": rmse.vertical}
            for part, value in parts.items():
                yield Row(name, f"{kind}_points_rmse_{part}", "", of, value, unit)


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


class Line(NamedTuple):
    """One row of the table: a label, and a text (or one a direction) for each candidate."""

    label: str
    cells: list[tuple[str, str]]  # (c→r, r→c); the second is empty where one number stands for both


def lines(comparison: SourcedComparison, *, intervals: bool = False) -> Iterator[Line | None]:
    """All rows of the table, with 95 % intervals if asked for; None stands for a rule."""
    candidates = comparison.candidates
    registered = [c.registration for c in candidates]
    yield Line("points", [(f"{c.points:,}", "") for c in candidates])
    yield Line("points in region", [(f"{c.points_in_region:,}", "") for c in candidates])
    yield Line("registration", [(r.method.partition(":")[0], "") for r in registered])
    yield Line("  rmse, overlap", [(number(r.rmse), f"{r.overlap:.1%}") for r in registered])
    yield None
    for metric in MEAN_METRICS:
        yield from _mean_lines(candidates, metric, intervals=intervals)
    for label, key in (
        ("Hausdorff (maximum)", "largest"),
        ("  99th percentile", "p99"),
        ("  95th percentile", "p95"),
    ):
        found = [c.metrics.hausdorff for c in candidates]
        yield Line(label, [(number(getattr(h[FORTH], key)), number(getattr(h[BACK], key))) for h in found])
    yield None
    for key in ("sum_unsquared", "sum_squared"):
        chamfer: list[Estimate] = [getattr(c.metrics.chamfer, key) for c in candidates]
        yield Line(LABELS[key], [(number(e.value, e.interval if intervals else None), "") for e in chamfer])
    for scores in zip(*(c.metrics.fscores for c in candidates), strict=True):
        cells = [(number(s.fscore.value, s.fscore.interval if intervals else None), "") for s in scores]
        yield Line(f"F-score at {number(scores[0].threshold)}", cells)
        cells = [(number(s.precision.value), number(s.recall.value)) for s in scores]
        yield Line("  precision, recall", cells)
    for preset in candidates[0].metrics.presets:
        yield None
        yield from _preset_lines(preset, [c.metrics.presets[preset] for c in candidates])
    yield None
    for name in candidates[0].deviation.maps:
        spreads = [Spread.of(c.deviation.maps[name]) for c in candidates]
        label = f"map {name.replace('_distance', '')}: bias, rms"
        yield Line(label, [(number(s.bias), number(s.rms)) for s in spreads])
        if name not in candidates[0].metrics.spreads:  # of those it stands above, in both directions
            yield from _spread_lines(spreads)
    yield from _bend_lines(candidates)
    along_normals = [c.deviation.m3c2 for c in candidates if c.deviation.m3c2 is not None]
    if len(along_normals) == len(candidates):
        spreads = [found.spread for found in along_normals]
        yield Line("map m3c2: bias, rms", [(number(s.bias), number(s.rms)) for s in spreads])
        yield from _spread_lines(spreads)
        cells = [(number(found.median_lod), number(found.significant_share)) for found in along_normals]
        yield Line("  median LoD95, significant", cells)


def _mean_lines(candidates: Sequence[Candidate], metric: MeanMetric, *, intervals: bool) -> Iterator[Line]:
    found = [c.metrics.directed[metric.name] for c in candidates]
    both = [(d.accuracy, d.completeness) for d in found]
    texts = [[number(e.value, e.interval if intervals else None) for e in pair] for pair in both]
    yield Line(metric.label, [(forth, back) for forth, back in texts])
    yield Line("  sampling floor", [(number(a.floor), number(b.floor)) for a, b in both])
    if metric.root_label is not None:  # a mean square: its root is what people imagine
        yield Line("  area-weighted", [(number(a.area_weighted), number(b.area_weighted)) for a, b in both])
        roots = [d.root() for d in found]
        yield Line(metric.root_label, [(number(d.accuracy.value), number(d.completeness.value)) for d in roots])
    if (kind := _SPREAD_OF.get(metric.name)) is not None:
        spreads = [c.metrics.spreads.get(kind) for c in candidates]
        for key, label in (("median", "median"), ("std", "standard deviation"), ("nmad", "NMAD")):
            pairs = [("–", "–") if s is None else tuple(number(getattr(s[w], key)) for w in ARROWS) for s in spreads]
            signed = ", signed" if kind == "plane_distance" and key == "median" else ""
            yield Line(f"  {label}{signed}", [(forth, back) for forth, back in pairs])


def _spread_lines(spreads: Sequence[Spread]) -> Iterator[Line]:
    yield Line("  median, NMAD", [(number(s.median), number(s.nmad)) for s in spreads])
    yield Line("  standard deviation", [(number(s.std), "") for s in spreads])


def _preset_lines(name: str, presets: Sequence[Preset]) -> Iterator[Line]:
    for key, first in _parts(presets[0]):
        values = [getattr(preset, key) for preset in presets]
        if isinstance(first, BothWays):  # its a is the reference: b to a is our candidate to reference
            yield Line(f"{name}: {key}", [(number(v.b_to_a), number(v.a_to_b)) for v in values])
        elif isinstance(first, tuple):
            for row, score in enumerate(first):
                label = f"{name}: F-score at {number(score.threshold)}"
                yield Line(label, [(number(v[row].fscore), "") for v in values])
        else:
            yield Line(f"{name}: {key}", [(number(v), "") for v in values])


def _bend_lines(candidates: Sequence[Candidate]) -> Iterator[Line]:
    bends = [c.deformation for c in candidates]
    yield Line("deformation", [(b.verdict, "") for b in bends])
    sizes = [None if b.amplitude is None else b.amplitude.rms for b in bends]
    cells = [(number(size), number(b.minimum_detectable_rms)) for size, b in zip(sizes, bends, strict=True)]
    yield Line("  bend RMS, detectable", cells)


def markdown(comparison: SourcedComparison) -> str:
    """`table.md`: the answer and the warnings, the table with 95 % intervals, the definitions, and every difference."""
    names = [candidate.name.replace("|", "\\|") for candidate in comparison]
    header = ["", *(f"{name} {arrow}" for name in names for arrow in ARROWS.values())]
    text = [
        f"# {title(comparison)}",
        "",
        " ".join(answer(comparison)),
        "",
        *(f"- {sentence}" for sentence in survey_sentences(comparison)),
        *(f"- warning: {' '.join(warning.splitlines())}" for warning in warnings(comparison)),
        "",
        _md_row(header),
        _md_row(["---"] + ["---:"] * (len(header) - 1)),
    ]
    for line in lines(comparison, intervals=True):
        if line is not None:
            label = f"&nbsp;&nbsp;{line.label.strip()}" if line.label.startswith("  ") else line.label
            text.append(_md_row([label, *(text for cell in line.cells for text in cell)]))
    text += ["", _legend(comparison), "", *(f"- {sentence}" for sentence in details(comparison))]
    return "\n".join(text).rstrip() + "\n"


def html(comparison: SourcedComparison) -> str:
    """For a notebook: the answer and the warnings, the table, and every difference; names are escaped."""
    right, left = "text-align:right;padding:1px 10px", "text-align:left;padding:1px 10px"
    names = "".join(f'<th colspan="2" style="text-align:center">{escape(c.name)}</th>' for c in comparison)
    ways = "".join(
        f'<th style="{right}">{_WAYS[way]} {arrow}</th>' for _ in comparison for way, arrow in ARROWS.items()
    )
    body = []
    for line in lines(comparison):
        if line is not None:
            is_detail = line.label.startswith("  ")
            style = f"{left};font-weight:normal;padding-left:2em;opacity:0.75" if is_detail else left
            cells = "".join(f'<td style="{right}">{escape(text)}</td>' for pair in line.cells for text in pair)
            body.append(f'<tr><th scope="row" style="{style}">{escape(line.label.strip())}</th>{cells}</tr>')
    first = [
        *answer(comparison),
        *survey_sentences(comparison),
        *(f"warning: {warning}" for warning in warnings(comparison)),
    ]
    return (
        f"<p><b>{escape(title(comparison))}</b></p>{_list(first)}"
        f"<table><thead><tr><th></th>{names}</tr><tr><th></th>{ways}</tr></thead><tbody>{''.join(body)}</tbody></table>"
        f"{_list(details(comparison))}<p>{escape(_legend(comparison))}</p>"
    )


def _list(sentences: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(sentence)}</li>' for sentence in sentences)}</ul>"


def _legend(comparison: SourcedComparison) -> str:
    return _LEGEND.format(unit=comparison.reference.unit or "the files' unit")


def _md_row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"
