"""The main numbers of a comparison: at most a dozen rows for one or two candidates, a row each for more."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from pcbench.measure.deviation import Spread
from pcbench.measure.results import BACK, FORTH, Candidate, DirectedMetric, ThresholdScores
from pcbench.report.inputs import SourcedComparison
from pcbench.report.table import Line
from pcbench.report.words import UNKNOWN, columns, number, rounding, shortened

MOST_ACROSS = 2  # candidates that stand side by side
_MOST_ROWS = 12
_GAP = 2  # blanks between columns
_LEAST_NAME = 16  # letters of a name that columns may not take


class Column(NamedTuple):
    """A column of the table with a row each: two lines of header, and a cell a candidate."""

    head: tuple[str, str]
    cells: list[str]

    @property
    def width(self) -> int:
        return max(map(columns, (*self.head, *self.cells)))


def main_lines(comparison: SourcedComparison) -> list[Line]:
    """For candidates side by side: metrics down, both directions across, the floor below what it belongs to."""
    candidates = list(comparison)
    show = _shown(comparison)

    def directed(label: str, of: Callable[[Candidate], DirectedMetric], root: bool = False) -> Iterator[Line]:
        found = [(of(c).accuracy, of(c).completeness) for c in candidates]
        yield Line(label, [(show(_root(a.value, root)), show(_root(b.value, root))) for a, b in found])
        yield Line("  sampling floor", [(show(_root(a.floor, root)), show(_root(b.floor, root))) for a, b in found])

    methods = {c.registration.method.partition(":")[0] for c in candidates}
    how = "registration" if len(methods) > 1 else methods.pop()
    fits = [(show(c.registration.rmse), f"{c.registration.overlap:.1%}") for c in candidates]
    h = [(c.metrics.hausdorff[FORTH], c.metrics.hausdorff[BACK]) for c in candidates]
    bends = [None if c.deformation.verdict == "undecided" else c.deformation.amplitude for c in candidates]
    sizes = [None if bend is None else bend.rms for bend in bends]
    limits = [c.deformation.minimum_detectable_rms for c in candidates]
    verdicts = [c.deformation.verdict for c in candidates]
    rows = [
        Line("points measured", [(f"{c.points_in_region:,}", f"{_measured(comparison):,}") for c in candidates]),
        Line(f"{how}: rmse, overlap", fits),
        *directed("RMS off the surface (D2)", lambda c: c.metrics.d2_mse, root=True),
        *directed("mean distance", lambda c: c.metrics.mean_distance),
        Line("95% lie within", [(show(a.p95), show(b.p95)) for a, b in h]),
        Line("all lie within (Hausdorff)", [(show(a.largest), show(b.largest)) for a, b in h]),
        Line("deformation", [(verdict, "") for verdict in verdicts]),
    ]
    if any(limit is not None for limit in limits):
        cells = [(show(size), show(limit)) for size, limit in zip(sizes, limits, strict=True)]
        rows.append(Line("  bend RMS, detectable", cells))
    wanted = [*_map_lines(candidates, comparison), *_score_lines(comparison)]
    return rows + wanted[: _MOST_ROWS - len(rows)]


def main_columns(comparison: SourcedComparison, width: int) -> list[Column]:
    """For a row each: as many as `width` columns of a terminal hold beside the names, the most telling ones first."""
    candidates = list(comparison)
    show = _shown(comparison, digits=3)
    d2, mean = ([c.metrics.directed[name] for c in candidates] for name in ("d2_mse", "mean_distance"))
    h = [c.metrics.hausdorff for c in candidates]
    pose = ["doubtful" if c.registration.doubtful else "" for c in candidates]
    ranked = [  # in the order in which they stand, with their rank
        (8, Column(("", "points"), [f"{c.points_in_region:,}" for c in candidates])),
        (0 if any(pose) else None, Column(("", "pose"), pose)),
        (4, Column(("", "overlap"), [f"{c.registration.overlap:.0%}" for c in candidates])),
        (0, Column(("D2 RMS", "c→r"), [show(_root(d.accuracy.value, True)) for d in d2])),
        (1, Column(("floor", "c→r"), [show(_root(d.accuracy.floor, True)) for d in d2])),
        (5, Column(("mean", "c→r"), [show(d.accuracy.value) for d in mean])),
        (5, Column(("floor", "c→r"), [show(d.accuracy.floor) for d in mean])),
        (0, Column(("mean", "r→c"), [show(d.completeness.value) for d in mean])),
        (1, Column(("floor", "r→c"), [show(d.completeness.floor) for d in mean])),
        (6, Column(("95%", "c→r"), [show(found[FORTH].p95) for found in h])),
        (6, Column(("95%", "r→c"), [show(found[BACK].p95) for found in h])),
        (9, Column(("largest", "c→r"), [show(found[FORTH].largest) for found in h])),
        (9, Column(("largest", "r→c"), [show(found[BACK].largest) for found in h])),
        *((3, _score_column(comparison, at)) for at in _thresholds(comparison)[:1]),
        (2, Column(("", "deformation"), [c.deformation.verdict for c in candidates])),
        (7, Column(("bend", "RMS"), [_bend_size(c, show) for c in candidates])),
    ]
    room = width - min(max(columns(c.name) for c in candidates), _LEAST_NAME)
    kept: set[int] = set()
    ranks = sorted({rank for rank, _ in ranked if rank is not None})
    for rank in ranks:
        some = {k for k, (of, _) in enumerate(ranked) if of == rank}
        needed = sum(ranked[k][1].width + _GAP for k in some)
        if rank > 0 and needed > room:
            break
        kept |= some
        room -= needed
    chosen = [column for k, (_, column) in enumerate(ranked) if k in kept]
    left = max(width - sum(column.width + _GAP for column in chosen), _LEAST_NAME // 2)
    return [Column(("", ""), _names(candidates, left)), *chosen]


def _names(candidates: list[Candidate], width: int) -> list[str]:
    """In the room that there is; with numbers where shortening would make two of them alike."""
    names = [shortened(c.name, width) for c in candidates]
    if len(set(names)) < len(names):
        names = [f"{k} {shortened(c.name, width - len(str(k)) - 1)}" for k, c in enumerate(candidates, 1)]
    return names


def _measured(comparison: SourcedComparison) -> int:
    return comparison.reference.points_in_region


def _map_lines(candidates: list[Candidate], comparison: SourcedComparison) -> Iterator[Line]:
    """Of the maps that were asked for, or that a mesh brings."""
    for name in candidates[0].deviation.maps:
        if name != "plane_distance":
            spreads = [Spread.of(c.deviation.maps[name]) for c in candidates]
            label = f"map {name.replace('_distance', '')}: bias, rms"
            yield Line(label, [(number(s.bias), number(s.rms)) for s in spreads])
    found = [c.deviation.m3c2 for c in candidates if c.deviation.m3c2 is not None]
    if len(found) == len(candidates):
        yield Line("map m3c2: bias, rms", [(number(m.spread.bias), number(m.spread.rms)) for m in found])
        yield Line("  median LoD95, significant", [(number(m.median_lod), number(m.significant_share)) for m in found])


def _score_lines(comparison: SourcedComparison) -> Iterator[Line]:
    for at in _thresholds(comparison):
        scores = [_score(c, at) for c in comparison]
        yield Line(f"F-score at {number(at)}", [(number(s.fscore.value), "") for s in scores])
        if len(_thresholds(comparison)) == 1:
            yield Line("  precision, recall", [(number(s.precision.value), number(s.recall.value)) for s in scores])


def _score_column(comparison: SourcedComparison, at: float) -> Column:
    values = [_score(c, at).fscore.value for c in comparison]
    return Column(("F-score", f"{at:.3g}"), [UNKNOWN if value is None else f"{value:.3f}" for value in values])


def _score(candidate: Candidate, at: float) -> ThresholdScores:
    return next(score for score in candidate.metrics.fscores if score.threshold == at)


def _thresholds(comparison: SourcedComparison) -> list[float]:
    """Those that were asked for; of the three that nobody asked for the one in the middle."""
    found = [score.threshold for score in comparison.candidates[0].metrics.fscores]
    return found if comparison.settings.thresholds is not None else found[len(found) // 2 :][:1]


def _bend_size(candidate: Candidate, show: Callable[[float | None], str]) -> str:
    bend = candidate.deformation
    return show(bend.amplitude.rms) if bend.amplitude is not None and bend.verdict == "non-affine" else ""


def _shown(comparison: SourcedComparison, digits: int = 4) -> Callable[[float | None], str]:
    """How lengths are shown: what is rounding is 0."""
    least = rounding(comparison)

    def show(value: float | None) -> str:
        return UNKNOWN if value is None else "0" if abs(value) <= least else f"{value:.{digits}g}"

    return show


def _root(value: float | None, root: bool) -> float | None:
    return value if value is None or not root else value**0.5
