"""Statements of accuracy in the words of standards.

ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2, Version 2 (2024), section 7.16, and National
Standard for Spatial Data Accuracy, FGDC-STD-007.3-1998, section 3.2.3 and appendix 3-A.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from pcbench.geometry.units import metres
from pcbench.measure.checkpoints.accuracy import CloudAccuracy, HorizontalAccuracy, VerticalAccuracy
from pcbench.measure.checkpoints.settings import CheckPointSettings

MIN_ASPRS_POINTS = 30
MIN_NSSDA_POINTS = 20
_EDITION = (
    "ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2, Version 2 (2024)"  # as in section 7.16
)
_NVA, _VVA = "Non-Vegetated Vertical Accuracy (NVA)", "Vegetated Vertical Accuracy (VVA)"
_VERTICAL_FACTOR = 1.96  # 95 % of normal errors, NSSDA 3-A.2
_RADIAL_FACTOR = 2.4477 * 0.5  # 95 % of circular normal errors, NSSDA 3-A.1; of equal errors 1.7308 RMSE_r
_MIN_RATIO = 0.6  # of the smaller to the larger of RMSE_x and RMSE_y, for this approximation


def statements(accuracy: CloudAccuracy, settings: CheckPointSettings) -> list[str]:
    """Return the statements of the standard that the settings choose, or why there is none, in whole sentences."""
    length = metres(accuracy.unit)
    if accuracy.every is None and accuracy.horizontal is None:
        return []
    if length is None:
        return ["No statement: the unit of the cloud is unknown, and statements are in centimetres: give --unit."]
    if settings.standard == "nssda":
        return list(_nssda(accuracy, length))
    return list(_asprs(accuracy, settings, 100.0 * length))


def _asprs(accuracy: CloudAccuracy, settings: CheckPointSettings, centimetres: float) -> Iterator[str]:
    wanted = settings.vertical_class
    for kind, vertical in ((_NVA, accuracy.nva), (_VVA, accuracy.vva)):
        if vertical is None:
            continue
        rmse = centimetres * vertical.rmse_v
        yield _asprs_sentence(vertical.errors.count, rmse, wanted, "RMSEV", "Vertical Accuracy Class", f"The {kind}")
        wanted = wanted or _smallest_class(rmse)  # the class of a data set is that of its open ground
    if (horizontal := accuracy.horizontal) is not None:
        yield _asprs_sentence(
            horizontal.x.count,
            centimetres * horizontal.rmse_h,
            settings.horizontal_class,
            "RMSEH",
            "Horizontal Positional Accuracy Class",
            "The tested horizontal positional accuracy",
        )
    if settings.vertical_class is None and accuracy.every is not None:
        yield (
            "The vertical class is the smallest of whole centimetres that the result meets: name the class that the"
            " project demands with --vertical-class."
        )


def _asprs_sentence(count: int, rmse: float, wanted: float | None, symbol: str, kind: str, subject: str) -> str:
    """Return the sentence of section 7.16 for a tested accuracy, in centimetres.

    Vegetated vertical accuracy is reported and has no limit; a class that another result does not meet has no sentence.
    """
    is_report = subject.endswith("(VVA)")
    met = _smallest_class(rmse) if wanted is None else wanted
    if rmse > met and not is_report:
        return (
            f"No statement: {symbol} = {_cm(rmse)} does not meet the {_class(met)} {symbol} {kind}"
            f" ({count} check points)."
        )
    finding = f"{subject} was found to be {symbol} = {_cm(rmse)}"
    if count >= MIN_ASPRS_POINTS:
        return f"This data set was tested to meet {_EDITION} for a {_class(met)} {symbol} {kind}. {finding}."
    return (
        f"This data set was tested as required by {_EDITION}. Although the Standards call for a minimum of thirty (30)"
        f" checkpoints, this test was performed using ONLY {count} checkpoints. This data set was produced to meet a"
        f" {_class(met)} {symbol} {kind}. {finding} using the reduced number of checkpoints."
    )


def _smallest_class(rmse: float) -> float:
    """Return the smallest class of whole centimetres that a root mean square in centimetres meets."""
    return float(max(1, math.ceil(round(rmse, 6))))


def _cm(value: float) -> str:
    return f"{value:.1f} (cm)"


def _class(value: float) -> str:
    return f"{value:g} (cm)"


def _nssda(accuracy: CloudAccuracy, length: float) -> Iterator[str]:
    parts, causes = [], []
    horizontal, vertical = accuracy.horizontal, accuracy.every
    if horizontal is not None:
        if horizontal.x.count < MIN_NSSDA_POINTS:
            causes.append(f"{horizontal.x.count} horizontal check points")
        elif (value := _nssda_horizontal(horizontal)) is None:
            yield (
                "No horizontal statement: the formula of NSSDA appendix 3-A holds if the smaller of RMSEx and RMSEy is"
                f" at least {_MIN_RATIO:g} times the larger."
            )
        else:
            parts.append(f"{value * length:.3f} meters horizontal accuracy at 95% confidence level")
    if vertical is not None:
        if vertical.errors.count < MIN_NSSDA_POINTS:
            causes.append(f"{vertical.errors.count} vertical check points")
        else:
            parts.append(f"{_nssda_vertical(vertical) * length:.3f} meters vertical accuracy at 95% confidence level")
    if parts:
        yield f"Tested {'; '.join(parts)}."
    if causes:
        yield (
            f"No statement for {' and '.join(causes)}: NSSDA (FGDC-STD-007.3-1998, 3.2.2) demands at least"
            f" {MIN_NSSDA_POINTS}."
        )


def _nssda_vertical(vertical: VerticalAccuracy) -> float:
    """Return Accuracy_z = 1.9600 RMSE_z."""
    return _VERTICAL_FACTOR * vertical.errors.rmse


def _nssda_horizontal(horizontal: HorizontalAccuracy) -> float | None:
    """Return Accuracy_r = 2.4477 * 0.5 * (RMSE_x + RMSE_y); None if these differ too much."""
    low, high = sorted((horizontal.x.rmse, horizontal.y.rmse))
    return _RADIAL_FACTOR * (low + high) if low >= _MIN_RATIO * high else None
