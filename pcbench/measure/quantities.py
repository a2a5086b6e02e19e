"""All quantities of a candidate, defined once.

comparison.json, metrics.csv, the table, the summary and the sentences on differences all render this sequence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace

from pcbench.deformation.result import NEGLIGIBLE_SHARE
from pcbench.deformation.size import DETECTION_POWER, MAX_P_SIGNIFICANT
from pcbench.measure.deviation import M3C2, Spread
from pcbench.measure.directions import MEAN_METRICS, MeanMetric
from pcbench.measure.intervals import Interval
from pcbench.measure.presets import DirectedValues, Preset
from pcbench.measure.quantity import LENGTH, RATIO, SQUARED_LENGTH, Headline, Quantity
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE, Candidate, Estimate

_UNITS = {0: RATIO, 1: LENGTH, 2: SQUARED_LENGTH}  # by the power of the unit of length
_SPREAD_DEFINITIONS = {  # the numbers of a `Spread` of signed values
    "bias": "mean",
    "rms": "root mean square",
    "median": "median",
    "std": "standard deviation",
    "nmad": "NMAD (1.4826 median |v - median v|)",
}
_SPREAD_LABELS = {"median": "median", "std": "standard deviation", "nmad": "NMAD"}
_DISTANCE_DEFINITIONS = {
    "distance": "distance to the nearest point",
    "plane_distance": "signed distance to the tangent plane",
}
_BUDGET_LABELS = {
    "unmatched": "budget of D2: no counterpart",
    "changed": "  changed",
    "motion": "  motion",
    "affine": "  stretch, shear",
    "smooth": "  smooth beyond affine",
    "noise": "  noise",
    "unexplained": "  unexplained",
}
_SPREAD_OF = {"mean_distance": "distance", "d2_mse": "plane_distance"}  # distances that each mean is taken over


def quantities(candidate: Candidate) -> Iterator[Quantity]:
    """Yield all quantities of a candidate, in the order of the table."""
    for part in _PARTS:
        yield from part(candidate)


def _means(candidate: Candidate) -> Iterator[Quantity]:
    for metric in MEAN_METRICS:
        for way in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
            yield from _mean(candidate.metrics.directed[metric.name][way], metric, way)
        larger = candidate.metrics.directed[metric.name].symmetric_max
        if larger is not None:
            yield _estimate_quantity(metric.name, "symmetric_max", metric.definition, larger, _UNITS[metric.power])
        if (kind := _SPREAD_OF.get(metric.name)) in candidate.metrics.spreads:
            yield from _distribution(candidate, str(kind))


def _mean(found: Estimate, metric: MeanMetric, way: str) -> Iterator[Quantity]:
    """Yield a mean in one direction, its floor, the area-weighted mean, and the roots of a mean square."""
    name, text, unit = metric.name, metric.definition, _UNITS[metric.power]
    headline = floor_headline = None
    if metric.headline:
        rank, floor_rank = metric.ranks[way != CANDIDATE_TO_REFERENCE]
        headline = Headline(metric.headline, column=metric.column, rank=rank)
        floor_headline = Headline("  sampling floor", column="floor", rank=floor_rank)
    root = metric.root_name  # shown in the summary instead of the mean square
    value = _estimate_quantity(name, way, text, found, unit, label=metric.label)
    yield value if root else replace(value, headline=headline)
    yield Quantity(
        f"{name}_floor",
        way,
        f"sampling floor of: {text}",
        found.floor,
        unit,
        path=("metrics", name, "floor", way),
        label="  sampling floor",
        headline=None if root else floor_headline,
    )
    yield Quantity(
        f"{name}_area_weighted",
        way,
        f"mean over voxels of: {text}",
        found.area_weighted,
        unit,
        path=("metrics", name, "area_weighted", way),
        label="  area-weighted" if root else "",
    )
    if root is None:
        return
    yield Quantity(
        root,
        way,
        f"root {text}",
        _root(found.value),
        _UNITS[metric.power // 2],
        path=("metrics", root, way),
        label=metric.root_label or "",
        headline=headline,
    )
    yield Quantity(
        f"{root}_floor",
        way,
        f"root of the sampling floor of: {text}",
        _root(found.floor),
        _UNITS[metric.power // 2],
        path=("metrics", root, "floor", way),
        headline=floor_headline,
    )


def _distribution(candidate: Candidate, kind: str) -> Iterator[Quantity]:
    """Yield the distribution of the distances of one kind, in both directions."""
    both = candidate.metrics.spreads[kind]
    for way in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
        for key, definition, value in _statistics(both[way], is_signed=kind == "plane_distance"):
            signed = ", signed" if kind == "plane_distance" and key == "median" else ""
            yield Quantity(
                f"{kind}_{key}",
                way,
                f"{definition} of: {_DISTANCE_DEFINITIONS[kind]}",
                value,
                path=("metrics", "spreads", kind, way, key),
                label=f"  {_SPREAD_LABELS[key]}{signed}" if key in _SPREAD_LABELS else "",
            )


def _budget(candidate: Candidate) -> Iterator[Quantity]:
    """Yield the parts of D2: the share of each one, its mean square, and the share of the points that it describes."""
    if candidate.budget is None:
        return
    for name, label in _BUDGET_LABELS.items():
        for way in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
            budget = candidate.budget[way]
            part = budget.parts[name]
            for metric, key, definition, value, unit in (
                ("budget_share", "share", "share of D2 in the part of its budget", budget.share(name), RATIO),
                ("budget_mse", "mean_square", "contribution to D2 of the part of its budget", part.mean_square,
                 SQUARED_LENGTH),
                ("budget_points", "point_share", "share of the points in the part of the budget", part.point_share,
                 RATIO),
            ):  # fmt: skip
                yield Quantity(
                    metric,
                    way,
                    f"{definition}: {name}",
                    value,
                    unit,
                    variant=name,
                    path=("budget", way, name, key),
                    section="budget",
                    label=label if key == "share" else "",
                )


def _largest_distances(candidate: Candidate) -> Iterator[Quantity]:
    found = candidate.metrics.hausdorff
    for rank in ("p95", "p99"):
        for way in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
            yield Quantity(
                f"hausdorff_{rank}",
                way,
                f"{rank[1:]}th percentile of the distances",
                getattr(found[way], rank),
                path=("metrics", "hausdorff", rank, way),
                label=f"{rank[1:]}th percentile",
                headline=Headline("95% lie within", column="95%", rank=6) if rank == "p95" else None,
            )
    for way, value in (
        (CANDIDATE_TO_REFERENCE, found.accuracy.largest),
        (REFERENCE_TO_CANDIDATE, found.completeness.largest),
        ("symmetric_max", found.symmetric_max),
    ):
        is_directed = way != "symmetric_max"
        yield Quantity(
            "hausdorff",
            way,
            "largest distance to the nearest point",
            value,
            path=("metrics", "hausdorff", way),
            label="Hausdorff (maximum)" if is_directed else "",
            headline=Headline("all lie within (Hausdorff)", column="largest", rank=9) if is_directed else None,
        )


def _maps(candidate: Candidate) -> Iterator[Quantity]:
    """Yield the deviation maps except the nearest-point distances; the table may already show their distribution."""
    deviation, spreads = candidate.deviation, candidate.metrics.spreads
    for name in deviation.maps:
        title = f"map {name.replace('_distance', '')}"
        is_signed = name not in deviation.unsigned
        for found in _map(deviation.spreads[name], name, title, is_signed=is_signed, is_new=name not in spreads):
            yield replace(found, path=("deviation", "maps", name, found.variant))
    if deviation.m3c2 is not None:
        yield from _m3c2(deviation.m3c2)


def _statistics(spread: Spread, *, is_signed: bool) -> Iterator[tuple[str, str, float | None]]:
    """Yield name, definition and value of each statistic; the mean of signed values is the bias."""
    for key, definition in _SPREAD_DEFINITIONS.items():
        yield "mean" if key == "bias" and not is_signed else key, definition, getattr(spread, key)


def _map(spread: Spread, name: str, title: str, *, is_signed: bool, is_new: bool) -> Iterator[Quantity]:
    """Yield the statistics of a map; the variant is the statistic's name."""
    mean = "bias" if is_signed else "mean"
    labels = {mean: f"{title}: {mean}", "rms": "  rms"}
    if is_new:
        labels |= {key: f"  {label}" for key, label in _SPREAD_LABELS.items()}
    for key, definition, value in _statistics(spread, is_signed=is_signed):
        is_main = is_new and key in (mean, "rms")
        yield Quantity(
            name,
            CANDIDATE_TO_REFERENCE,
            f"{definition} of the deviation map",
            value,
            variant=key,
            section="maps",
            label=labels.get(key, ""),
            headline=Headline(f"{title}: {key}", optional=True) if is_main else None,
        )


def _m3c2(m3c2: M3C2) -> Iterator[Quantity]:
    for found in _map(m3c2.spread, "m3c2", "map m3c2", is_signed=True, is_new=True):
        yield replace(found, metric=f"m3c2_{found.variant}", variant="", path=("deviation", "m3c2", found.variant))
    for key, label, definition, value, unit in (
        ("lod95_median", "median LoD95", "median level of detection at 95 %", m3c2.median_lod, LENGTH),
        (
            "significant_share",
            "significant share",
            "share of the distances beyond their level of detection",
            m3c2.significant_share,
            RATIO,
        ),
    ):
        yield Quantity(
            f"m3c2_{key}",
            CANDIDATE_TO_REFERENCE,
            definition,
            value,
            unit,
            path=("deviation", "m3c2", key),
            section="maps",
            label=f"  {label}",
            headline=Headline(f"  {label}", optional=True),
        )


def _chamfer(candidate: Candidate) -> Iterator[Quantity]:
    chamfer = candidate.metrics.chamfer
    for variant, found, definition, unit, label in (
        ("sum_unsquared", chamfer.sum_unsquared, "mean c→r + mean r→c", LENGTH, "means"),
        ("sum_squared", chamfer.sum_squared, "mean square c→r + mean square r→c", SQUARED_LENGTH, "mean squares"),
    ):
        title, path = f"Chamfer, sum of {label}", ("metrics", "chamfer", variant)
        value = _estimate_quantity("chamfer", "both", definition, found, unit, section="scores", label=title)
        yield replace(value, variant=variant, path=path, difference=f"chamfer/{variant}")
        floor = Quantity("chamfer_floor", "both", f"sampling floor of: {definition}", found.floor, unit, variant)
        yield replace(floor, path=("metrics", "chamfer", "floor", variant), section="scores")


def _fscores(candidate: Candidate) -> Iterator[Quantity]:
    for number, scores in enumerate(candidate.metrics.fscores):
        label = f"F-score at {scores.threshold:.4g}"
        headline = Headline(label, optional=True, column="F-score", rank=3)
        fscore = _estimate_quantity("fscore", "both", "harmonic mean of precision and recall", scores.fscore, RATIO)
        yield replace(
            fscore,
            threshold=scores.threshold,
            path=("metrics", "fscore", number, "fscore"),
            difference=f"fscore/{scores.threshold!r}",
            section="scores",
            label=label,
            headline=headline,
        )
        label = "  precision, recall"
        for metric, way, whose, found in (
            ("precision", CANDIDATE_TO_REFERENCE, "candidate", scores.precision),
            ("recall", REFERENCE_TO_CANDIDATE, "reference", scores.recall),
        ):
            share = _estimate_quantity(metric, way, f"share of the {whose}'s points within the threshold", found, RATIO)
            yield replace(
                share,
                threshold=scores.threshold,
                path=("metrics", "fscore", number, metric),
                difference="",
                section="scores",
                label=label,
                shares_row=label,
                headline=Headline(label, optional=True),
            )


def _presets(candidate: Candidate) -> Iterator[Quantity]:
    for name, preset in candidate.metrics.presets.items():
        yield from _preset(name, preset)


def _preset(name: str, preset: Preset) -> Iterator[Quantity]:
    """Yield the values of a preset, without units, which the quoted tool leaves open."""
    blank = Quantity("", "", f"preset {name}", None, unit="", variant=name, section=f"preset {name}")
    for key, value in vars(preset).items():
        path, label = ("metrics", "presets", name, key), f"{name}: {key}"
        if isinstance(value, DirectedValues):  # its a is the reference: b to a is our candidate to reference
            for way, number in asdict(value).items():
                found = replace(blank, metric=key, direction=way, value=number, path=(*path, way))
                yield found if way == "symmetric" else replace(found, label=label, second=way == "a_to_b")
        elif isinstance(value, tuple):
            for row, score in enumerate(value):
                at = score.threshold
                for metric in ("precision", "recall", "fscore"):
                    found = replace(blank, metric=metric, direction="both", threshold=at, path=(*path, row, metric))
                    found = replace(found, value=getattr(score, metric))
                    yield replace(found, label=f"{name}: F-score at {at:.4g}") if metric == "fscore" else found
        else:
            yield replace(blank, metric=key, value=value, path=path, label=label)


def _deformation(candidate: Candidate) -> Iterator[Quantity]:
    """Yield the summary of the deformation; comparison.json holds the complete object."""
    bend = candidate.deformation
    verdict = f"verdict: {bend.verdict}"
    size, text = bend.amplitude, f"along the normals, beyond affine; {verdict}"
    rms = Quantity("deformation_rms", "", text, None, section="deformation", label="  RMS")
    if size is None:
        yield rms
    else:
        yield replace(rms, value=size.rms, interval=Interval(*size.ci))
        yield Quantity("deformation_max", "", text, size.max, section="deformation")
    power, p = f"{100 * DETECTION_POWER:g} %", f"{MAX_P_SIGNIFICANT:g}"
    text = f"RMS of a dome that is detected in {power} of all cases at p <= {p}; {verdict}"
    yield Quantity("minimum_detectable_rms", "", text, bend.minimum_detectable_rms, section="deformation")
    text = f"RMS of a dome that is detected, its interval above {NEGLIGIBLE_SHARE:.0%} of the noise; {verdict}"
    yield Quantity("detectable_rms", "", text, bend.size_limit, section="deformation", label="  detectable RMS")


def _survey(candidate: Candidate) -> Iterator[Quantity]:
    """Yield the root mean square errors at control and check points, if the registration used such points."""
    residuals = candidate.registration.residuals
    for kind, points in (("control", residuals.control), ("check", residuals.check)):
        if (rmse := residuals.rmse(points)) is None:
            continue
        for part, variant in (("total", "3d"), ("horizontal", "horizontal"), ("vertical", "vertical")):
            yield Quantity(
                f"{kind}_points_rmse",
                "",
                f"root mean square error of {rmse.points} {kind} points",
                getattr(rmse, part),
                variant=variant,
                path=("registration", "point_rmse", kind, part),
                section="survey",
            )


def _estimate_quantity(
    metric: str, way: str, definition: str, found: Estimate, unit: str, section: str = "distances", label: str = ""
) -> Quantity:
    """Return a quantity with an interval, by which candidates are also compared."""
    return Quantity(
        metric,
        way,
        definition,
        found.value,
        unit,
        interval=found.interval,
        has_interval=True,
        path=("metrics", metric, way),
        difference=f"{metric}/{way}",
        section=section,
        label=label,
    )


def _root(value: float | None) -> float | None:
    return None if value is None else math.sqrt(value)


_PARTS: tuple[Callable[[Candidate], Iterator[Quantity]], ...] = (
    _means,
    _largest_distances,
    _budget,
    _maps,
    _chamfer,
    _fscores,
    _presets,
    _deformation,
    _survey,
)
