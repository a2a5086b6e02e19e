"""Accuracy by check points in sentences and tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pcbench.measure.checkpoints import CloudAccuracy, PointError
from pcbench.measure.checkpoints.accuracy import VerticalAccuracy
from pcbench.measure.checkpoints.statistics import OUTLIER_NMADS, ErrorStatistics
from pcbench.measure.wording import pluralize
from pcbench.report.markup import csv_text
from pcbench.report.words import UNKNOWN, join_words, length, length_number

_MAX_LISTED = 8
_MAX_SLOPE = 0.1  # rise over run, above which a horizontal error of the cloud shows in dz
_CLASSES = {False: "non-vegetated", True: "vegetated"}
_SURFACES = {
    "tin": "linear interpolation in the triangle of the cloud's points around each check point (TIN)",
    "plane": "a plane fitted to the cloud's points around each check point",
}
_CSV = (
    *("name", "class", "x", "y", "z", "dz", "dx", "dy", "outlier", "method", "spacing", "noise", "slope"),
    "not_covered",
)


def accuracy_sentences(accuracy: CloudAccuracy, name: str) -> list[str]:
    """Return how accurate a cloud is at the check points, the most important sentence first."""
    return [*_heights(accuracy, name), *_horizontal(accuracy), *caveats(accuracy)]


def headline(accuracy: CloudAccuracy) -> str:
    """Return the vertical accuracy at all covered check points in one clause."""
    every, unit = accuracy.every, accuracy.unit
    if every is None:
        return f"none of {pluralize(len(accuracy.points), 'check point')} is covered"
    return (
        f"RMSE {length(every.errors.rmse, unit)}, bias {signed(every.errors.mean, unit)} at"
        f" {pluralize(every.errors.count, 'check point')}"
    )


def _heights(accuracy: CloudAccuracy, name: str) -> Iterator[str]:
    groups = [(group, kind) for kind, group in ((False, accuracy.nva), (True, accuracy.vva)) if group is not None]
    if not groups:
        yield f"{name} covers none of {pluralize(len(accuracy.points), 'check point')}{_colon(accuracy.hint)}."
        return
    first, *others = groups
    yield f"Heights of {name} are accurate to {_vertical(accuracy, *first)}."
    for other in others:
        yield f"On vegetated ground: {_vertical(accuracy, *other)}."
    for group, kind in groups:
        yield _bias(group.errors, accuracy.unit, f" on {_CLASSES[kind]} ground" if len(groups) > 1 else "")


def _vertical(accuracy: CloudAccuracy, group: VerticalAccuracy, vegetated: bool) -> str:
    unit, errors = accuracy.unit, group.errors
    low, high = (length_number(end) for end in errors.rmse_interval)
    text = f"RMSE {length(errors.rmse, unit)} [{low}, {high}]"
    if group.survey_rmse:
        text = (
            f"{length(group.rmse_v, unit)} (RMSE_V, from RMSE {length(errors.rmse, unit)} [{low}, {high}] and the"
            f" survey's own {length(group.survey_rmse, unit)})"
        )
    return f"{text} at {errors.count:,} {_CLASSES[vegetated]} check point{'' if errors.count == 1 else 's'}"


def _bias(errors: ErrorStatistics, unit: str | None, where: str) -> str:
    if errors.count == 1:
        return f"The only error{where} is {signed(errors.mean, unit)} (cloud minus survey)."
    side = "above" if errors.mean > 0 else "below"
    text = f"The cloud lies {length(abs(errors.mean), unit)} {side} the check points{where} on average (bias)"
    return f"{text}, more than chance explains." if errors.is_biased else f"{text}, no more than chance explains."


def _horizontal(accuracy: CloudAccuracy) -> Iterator[str]:
    horizontal, unit = accuracy.horizontal, accuracy.unit
    if horizontal is None:
        return
    survey = f", the survey's own {length(horizontal.survey_rmse, unit)} included" if horizontal.survey_rmse else ""
    yield (
        f"Horizontal accuracy at {pluralize(horizontal.x.count, 'target')}: RMSE_H {length(horizontal.rmse_h, unit)}"
        f"{survey} (RMSE_x {length(horizontal.x.rmse, unit)}, RMSE_y {length(horizontal.y.rmse, unit)}; bias"
        f" {signed(horizontal.x.mean, unit)} in x, {signed(horizontal.y.mean, unit)} in y)."
    )


def caveats(accuracy: CloudAccuracy) -> Iterator[str]:
    """Yield what limits the accuracy of the numbers: uncovered points, outliers, slopes, an unknown survey error."""
    unit = accuracy.unit
    if accuracy.covered and accuracy.uncovered:
        listed = join_words([f"{point.name} ({point.reason})" for point in accuracy.uncovered], _MAX_LISTED)
        yield (
            f"The cloud does not cover {len(accuracy.uncovered)} of {pluralize(len(accuracy.points), 'check point')},"
            f" which have no error: {listed}."
        )
    if outliers := accuracy.outliers:
        listed = join_words([f"{point.name} ({signed(point.dz, unit)})" for point in outliers], _MAX_LISTED)
        kind = pluralize(len(outliers), "outlier")
        yield f"{kind} beyond {OUTLIER_NMADS:g} NMAD, included in all numbers: {listed}."
    if steep := [point.name for point in accuracy.covered if (point.slope or 0.0) > _MAX_SLOPE]:
        yield (
            f"{pluralize(len(steep), 'slope')} above {100 * _MAX_SLOPE:.0f} %, where a horizontal error of the cloud"
            f" shows in the height: at {join_words(steep, _MAX_LISTED)}."
        )
    if accuracy.every is not None and accuracy.every.survey_rmse is None:
        yield (
            "The survey's own error is unknown and counts as 0: state it in a column sigma_z or by --sigma-z, because"
            " the accuracy of the product includes it."
        )


def method_sentence(accuracy: CloudAccuracy) -> str:
    """Return how the heights of the cloud were found."""
    text = f"Heights of the cloud are from {_SURFACES[accuracy.surface]}; errors are cloud minus survey"
    if accuracy.noise is None or accuracy.spacing is None:
        return f"{text}."
    unit = accuracy.unit
    return (
        f"{text}. Around the check points the cloud's point spacing is {length(accuracy.spacing, unit)}, and its points"
        f" scatter by {length(accuracy.noise, unit)} about local planes (medians)."
    )


def statistics_rows(accuracy: CloudAccuracy) -> list[list[str]]:
    """Return a table of the statistics, with a header and a column for each kind of error."""
    columns: list[tuple[str, ErrorStatistics, float | None, float | None]] = []
    for label, group in (("dz, non-vegetated", accuracy.nva), ("dz, vegetated", accuracy.vva)):
        if group is not None:
            columns.append((label, group.errors, group.survey_rmse, group.rmse_v))
    if (horizontal := accuracy.horizontal) is not None:
        columns += [("dx", horizontal.x, None, None), ("dy", horizontal.y, None, None)]
    if not columns:
        return []
    unit = f" [{accuracy.unit}]" if accuracy.unit else ""

    def row(label: str, values: Sequence[float | None]) -> list[str]:
        return [label, *(UNKNOWN if value is None else f"{value:.3f}" for value in values)]

    statistics = [errors for _, errors, _, _ in columns]
    rows = [
        [f"Errors{unit}", *(label for label, *_ in columns)],
        ["check points", *(f"{errors.count:,}" for errors in statistics)],
        row("mean (bias)", [errors.mean for errors in statistics]),
        row("median", [errors.median for errors in statistics]),
        row("standard deviation", [errors.standard_deviation for errors in statistics]),
        row("NMAD", [errors.nmad for errors in statistics]),
        row("68.3 % of absolute errors below", [errors.p68 for errors in statistics]),
        row("95 % of absolute errors below", [errors.p95 for errors in statistics]),
        row("largest absolute error", [errors.largest for errors in statistics]),
        row("RMSE", [errors.rmse for errors in statistics]),
        ["95 % interval of the RMSE", *("{:.3f} to {:.3f}".format(*errors.rmse_interval) for errors in statistics)],
        row("survey's own error (RMSE_V2)", [survey for _, _, survey, _ in columns]),
        row("accuracy (RMSE_V)", [total for *_, total in columns]),
    ]
    return rows


def point_rows(accuracy: CloudAccuracy) -> list[list[str]]:
    """Return a table of the errors at each check point, with a header."""
    has_targets = accuracy.horizontal is not None
    unit = f" [{accuracy.unit}]" if accuracy.unit else ""
    rows = [["Check point", "class", f"dz{unit}", *([f"dx{unit}", f"dy{unit}"] if has_targets else []), "note"]]
    for point in accuracy.points:
        errors = [point.dz, *([point.dx, point.dy] if has_targets else [])]
        cells = [UNKNOWN if value is None else f"{value:+.3f}".replace("-", "−") for value in errors]
        rows.append([point.name, _CLASSES[point.vegetated], *cells, _note(point)])
    return rows


def point_csv(accuracy: CloudAccuracy) -> str:
    """Return the errors at each check point as CSV."""
    return csv_text(
        _CSV,
        (
            [
                *(point.name, "vva" if point.vegetated else "nva", point.x, point.y, point.z),
                *(point.dz, point.dx, point.dy, int(point.is_outlier), point.method or None),
                *(point.spacing, point.noise, point.slope, point.reason or None),
            ]
            for point in accuracy.points
        ),
    )


def _note(point: PointError) -> str:
    if point.dz is None:
        return f"not covered: {point.reason}"
    notes = ["outlier"] if point.is_outlier else []
    if point.method == "measured":
        notes.append("height of the target as measured")
    return ", ".join(notes)


def signed(value: float | None, unit: str | None) -> str:
    """Return a length with its sign and its unit."""
    text = length(value, unit)
    return text if value is None or value < 0 else f"+{text}"


def _colon(text: str) -> str:
    return f": {text}" if text else ""
