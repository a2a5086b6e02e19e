"""All quantities of a candidate, defined once.

comparison.json, metrics.csv, the table, the summary and the sentences on differences all render this sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, replace

from pcbench.deformation.result import NEGLIGIBLE_SHARE
from pcbench.deformation.size import DETECTION_POWER, MAX_P_SIGNIFICANT
from pcbench.measure.budget import PARTS
from pcbench.measure.deviation import M3C2, Spread
from pcbench.measure.directions import MEAN_METRICS, MeanMetric
from pcbench.measure.intervals import Interval
from pcbench.measure.library_presets import DirectedValues
from pcbench.measure.presets import Preset
from pcbench.measure.quantity import LENGTH, RATIO, SQUARED_LENGTH, Quantity
from pcbench.measure.results import ARROWS, CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE, Candidate, Estimate

_SPREAD_DEFINITIONS = {  # the numbers of a `Spread` of signed values
    "bias": "mean",
    "rms": "root mean square",
    "median": "median",
    "std": "standard deviation",
    "nmad": "NMAD (1.4826 median |v - median v|)",
}
_DISTANCE_DEFINITIONS = {
    "distance": "distance to the nearest point",
    "plane_distance": "signed distance to the tangent plane",
}
_SHARE_WITHIN = "share of the {}'s points within the threshold"
_SPREAD_OF = {"mean_distance": "distance", "d2_mse": "plane_distance"}  # distances that each mean is taken over


def quantities(candidate: Candidate) -> Iterator[Quantity]:
    """Yield all quantities of a candidate, in the order of the table."""
    for part in _PARTS:
        yield from part(candidate)


def _means(candidate: Candidate) -> Iterator[Quantity]:
    for metric in MEAN_METRICS:
        directed = candidate.metrics.directed[metric.name]
        for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
            yield from _mean(directed[direction], metric, direction)
        if directed.symmetric_max is not None:
            larger = _estimated(metric.name, "symmetric_max", metric.definition, directed.symmetric_max, metric.unit)
            yield larger
            if metric.root_name is not None:
                yield _root_of(larger, metric.root_name, directed.symmetric_max)
        if (kind := _SPREAD_OF.get(metric.name)) in candidate.metrics.spreads:
            yield from _distribution(candidate, str(kind))


def _mean(estimate: Estimate, metric: MeanMetric, direction: str) -> Iterator[Quantity]:
    """Yield a mean in one direction, its floor, the area-weighted mean, and the roots of a mean square."""
    name, text = metric.name, metric.definition
    mean = _estimated(name, direction, text, estimate, metric.unit)
    blank = Quantity("", direction, "", None, metric.unit)
    yield mean
    yield replace(
        blank,
        metric=f"{name}_floor",
        definition=f"sampling floor of: {text}",
        value=estimate.floor,
        path=("metrics", name, "floor", direction),
    )
    yield replace(
        blank,
        metric=f"{name}_area_weighted",
        definition=f"mean over voxels of: {text}",
        value=estimate.area_weighted,
        path=("metrics", name, "area_weighted", direction),
    )
    if metric.root_name is None:
        return
    yield _root_of(mean, metric.root_name, estimate)
    yield Quantity(
        f"{metric.root_name}_floor",
        direction,
        f"root of the sampling floor of: {text}",
        estimate.root().floor,
        path=("metrics", metric.root_name, "floor", direction),
    )


def _root_of(square: Quantity, name: str, estimate: Estimate) -> Quantity:
    """Return the root of a mean square, with the roots of the ends of its interval."""
    root = estimate.root()
    return Quantity(
        name,
        square.direction,
        f"root {square.definition}",
        root.value,
        interval=root.interval,
        has_interval=True,
        path=("metrics", name, square.direction),
        square=square,
    )


def _distribution(candidate: Candidate, kind: str) -> Iterator[Quantity]:
    """Yield the distribution of the distances of one kind, in both directions."""
    spread = candidate.metrics.spreads[kind]
    for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
        for key, definition, value in _statistics(spread[direction], is_signed=kind == "plane_distance"):
            yield Quantity(
                f"{kind}_{key}",
                direction,
                f"{definition} of: {_DISTANCE_DEFINITIONS[kind]}",
                value,
                path=("metrics", "spreads", kind, direction, key),
            )
    if kind == "plane_distance" and candidate.offset is not None:
        text = "median signed distance to the tangent plane, of the points near the surface"
        yield Quantity(
            "offset", CANDIDATE_TO_REFERENCE, text, candidate.offset.median, interval=candidate.offset.interval
        )


def _largest_distances(candidate: Candidate) -> Iterator[Quantity]:
    hausdorff = candidate.metrics.hausdorff
    for rank in ("p95", "p99"):
        for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
            yield Quantity(
                f"hausdorff_{rank}",
                direction,
                f"{rank[1:]}th percentile of the distances",
                getattr(hausdorff[direction], rank),
                path=("metrics", "hausdorff", rank, direction),
            )
    for direction, value in (
        (CANDIDATE_TO_REFERENCE, hausdorff.accuracy.largest),
        (REFERENCE_TO_CANDIDATE, hausdorff.completeness.largest),
        ("symmetric_max", hausdorff.symmetric_max),
    ):
        yield Quantity(
            "hausdorff",
            direction,
            "largest distance to the nearest point",
            value,
            path=("metrics", "hausdorff", direction),
        )


def _budget(candidate: Candidate) -> Iterator[Quantity]:
    """Yield the parts of D2: the share of each one, its mean square, and the share of the points that it describes."""
    if candidate.budget is None:
        return
    for name in PARTS:
        for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
            budget = candidate.budget[direction]
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
                    direction,
                    f"{definition}: {name}",
                    value,
                    unit,
                    variant=name,
                    path=("budget", direction, name, key),
                    group="budget",
                )


def _maps(candidate: Candidate) -> Iterator[Quantity]:
    """Yield the statistics of the deviation maps except the nearest-point distances, and M3C2."""
    deviation = candidate.deviation
    for name in deviation.maps:
        for statistic in _map(deviation.spreads[name], name, is_signed=name not in deviation.unsigned):
            yield replace(statistic, path=("deviation", "maps", name, statistic.variant))
    if deviation.m3c2 is not None:
        yield from _m3c2(deviation.m3c2)


def _map(spread: Spread, name: str, *, is_signed: bool) -> Iterator[Quantity]:
    """Yield the statistics of a map; the variant is the statistic's name."""
    for key, definition, value in _statistics(spread, is_signed=is_signed):
        text = f"{definition} of the deviation map"
        yield Quantity(name, CANDIDATE_TO_REFERENCE, text, value, variant=key, group="maps")


def _m3c2(m3c2: M3C2) -> Iterator[Quantity]:
    for statistic in _map(m3c2.spread, "m3c2", is_signed=True):
        key = statistic.variant
        yield replace(statistic, metric=f"m3c2_{key}", variant="", path=("deviation", "m3c2", key))
    for key, definition, value, unit in (
        ("lod95_median", "median level of detection at 95 %", m3c2.median_lod, LENGTH),
        ("significant_share", "share of the distances beyond their level of detection", m3c2.significant_share, RATIO),
    ):
        yield Quantity(
            f"m3c2_{key}",
            CANDIDATE_TO_REFERENCE,
            definition,
            value,
            unit,
            path=("deviation", "m3c2", key),
            group="maps",
        )


def _statistics(spread: Spread, *, is_signed: bool) -> Iterator[tuple[str, str, float | None]]:
    """Yield name, definition and value of each statistic; the mean of signed values is the bias."""
    for key, definition in _SPREAD_DEFINITIONS.items():
        yield "mean" if key == "bias" and not is_signed else key, definition, getattr(spread, key)


def _chamfer(candidate: Candidate) -> Iterator[Quantity]:
    chamfer = candidate.metrics.chamfer
    for variant, estimate, definition, unit in (
        ("sum_unsquared", chamfer.sum_unsquared, "mean c→r + mean r→c", LENGTH),
        ("sum_squared", chamfer.sum_squared, "mean square c→r + mean square r→c", SQUARED_LENGTH),
    ):
        value = _estimated("chamfer", "both", definition, estimate, unit, group="scores")
        path = ("metrics", "chamfer", variant)
        yield replace(value, variant=variant, path=path, difference=f"chamfer/{variant}")
        floor = Quantity("chamfer_floor", "both", f"sampling floor of: {definition}", estimate.floor, unit, variant)
        yield replace(floor, path=("metrics", "chamfer", "floor", variant), group="scores")


def _fscores(candidate: Candidate) -> Iterator[Quantity]:
    for number, scores in enumerate(candidate.metrics.fscores):
        for metric, direction, definition, estimate, difference in (
            ("fscore", "both", "harmonic mean of precision and recall", scores.fscore, f"fscore/{scores.threshold!r}"),
            ("precision", CANDIDATE_TO_REFERENCE, _SHARE_WITHIN.format("candidate"), scores.precision, ""),
            ("recall", REFERENCE_TO_CANDIDATE, _SHARE_WITHIN.format("reference"), scores.recall, ""),
        ):
            yield replace(
                _estimated(metric, direction, definition, estimate, RATIO, group="scores"),
                threshold=scores.threshold,
                path=("metrics", "fscore", number, metric),
                difference=difference,
            )


def _presets(candidate: Candidate) -> Iterator[Quantity]:
    for name, preset in candidate.metrics.presets.items():
        yield from _preset(name, preset)


def _preset(name: str, preset: Preset) -> Iterator[Quantity]:
    """Yield the values of a preset, without units, which the quoted tool leaves open."""
    blank = Quantity("", "", f"preset {name}", None, unit="", variant=name, group=f"preset {name}")
    for key, value in vars(preset).items():
        path = ("metrics", "presets", name, key)
        if isinstance(value, DirectedValues):  # its a is the reference: b to a is our candidate to reference
            for direction, number in asdict(value).items():
                yield replace(blank, metric=key, direction=direction, value=number, path=(*path, direction))
        elif isinstance(value, tuple):
            for row, scores in enumerate(value):
                for metric in ("precision", "recall", "fscore"):
                    yield replace(
                        blank,
                        metric=metric,
                        direction="both",
                        value=getattr(scores, metric),
                        threshold=scores.threshold,
                        path=(*path, row, metric),
                    )
        else:
            yield replace(blank, metric=key, value=value, path=path)


def _own(candidate: Candidate) -> Iterator[Quantity]:
    """Yield the values of user-defined metrics; keys that are directions are in one line."""
    for name, result in candidate.metrics.own.items():
        blank = Quantity(
            f"own.{name}", "", result.definition, None, unit="", path=("metrics", "own", name), group="own"
        )
        if not result.values:
            yield blank
        for key, value in result.values.items():
            yield replace(
                blank,
                direction=key if key in ARROWS else "",
                variant="" if key in ARROWS else key,
                value=value.value,
                unit=value.unit,
                interval=None if value.interval is None else Interval(*value.interval),
                has_interval=value.interval is not None,
                path=(*blank.path, key) if key else blank.path,
            )


def _deformation(candidate: Candidate) -> Iterator[Quantity]:
    """Yield the summary of the deformation; comparison.json holds the complete object."""
    deformation = candidate.deformation
    verdict = f"verdict: {deformation.verdict}"
    size, text = deformation.amplitude, f"along the normals, beyond affine; {verdict}"
    if size is None:
        yield Quantity("deformation_rms", "", text, None, group="deformation")
    else:
        yield Quantity("deformation_rms", "", text, size.rms, interval=Interval(*size.ci), group="deformation")
        yield Quantity("deformation_max", "", text, size.max, group="deformation")
    power, p = f"{100 * DETECTION_POWER:g} %", f"{MAX_P_SIGNIFICANT:g}"
    text = f"RMS of a dome that is detected in {power} of all cases at p <= {p}; {verdict}"
    yield Quantity("minimum_detectable_rms", "", text, deformation.minimum_detectable_rms, group="deformation")
    text = f"RMS of a dome that is detected, its interval above {NEGLIGIBLE_SHARE:.0%} of the noise; {verdict}"
    yield Quantity("detectable_rms", "", text, deformation.size_limit, group="deformation")


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
                group="survey",
            )


def _estimated(
    metric: str, direction: str, definition: str, estimate: Estimate, unit: str, group: str = "distances"
) -> Quantity:
    """Return a quantity with an interval, by which candidates are also compared."""
    return Quantity(
        metric,
        direction,
        definition,
        estimate.value,
        unit,
        interval=estimate.interval,
        has_interval=True,
        path=("metrics", metric, direction),
        difference=f"{metric}/{direction}",
        group=group,
    )


_PARTS: tuple[Callable[[Candidate], Iterator[Quantity]], ...] = (
    _means,
    _largest_distances,
    _budget,
    _maps,
    _chamfer,
    _fscores,
    _presets,
    _own,
    _deformation,
    _survey,
)
