"""Statements of accuracy in the words of standards.

ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2, Version 2 (2024), section 7.16, and National
Standard for Spatial Data Accuracy, FGDC-STD-007.3-1998, section 3.2.3 and appendix 3-A.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from pcbench.geometry.units import metres
from pcbench.measure.checkpoints.accuracy import CloudAccuracy, HorizontalAccuracy, VerticalAccuracy
from pcbench.measure.checkpoints.settings import CheckPointSettings


class _AccuracyClass(NamedTuple):
    """The root mean square that a class of ASPRS limits, and the name of the class."""

    symbol: str
    name: str


MIN_ASPRS_POINTS = 30
MIN_NSSDA_POINTS = 20
_EDITION = (
    "ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2, Version 2 (2024)"  # as in section 7.16
)
_NVA, _VVA = "Non-Vegetated Vertical Accuracy (NVA)", "Vegetated Vertical Accuracy (VVA)"
_VERTICAL = _AccuracyClass("RMSEV", "Vertical Accuracy Class")
_HORIZONTAL = _AccuracyClass("RMSEH", "Horizontal Positional Accuracy Class")
_VERTICAL_FACTOR = 1.96  # 95 % of normal errors, NSSDA 3-A.2
_RADIAL_FACTOR = 2.4477 * 0.5  # 95 % of circular normal errors, NSSDA 3-A.1; of equal errors 1.7308 RMSE_r
_ROUNDED_DIGITS = 6  # of centimetres: rounding errors exceed no class
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
    vertical_class = settings.vertical_class
    if (nva := accuracy.nva) is not None:
        rmse = centimetres * nva.rmse_v
        vertical_class = vertical_class or _smallest_class(rmse)
        yield _asprs_sentence(nva.errors.count, rmse, vertical_class, _VERTICAL, f"The {_NVA}")
    if (vva := accuracy.vva) is not None:
        yield _vegetated(vva, nva, vertical_class, centimetres)
    if (horizontal := accuracy.horizontal) is not None:
        rmse = centimetres * horizontal.rmse_h
        horizontal_class = settings.horizontal_class or _smallest_class(rmse)
        subject = "The tested horizontal positional accuracy"
        yield _asprs_sentence(horizontal.x.count, rmse, horizontal_class, _HORIZONTAL, subject)
    if settings.vertical_class is None and nva is not None:
        yield (
            "The vertical class is the smallest of whole centimetres that the result meets: name the class that the"
            " project demands with --vertical-class."
        )


def _vegetated(
    vva: VerticalAccuracy, nva: VerticalAccuracy | None, vertical_class: float | None, centimetres: float
) -> str:
    """Return the sentence on vegetated ground, which is reported as found: the class is that of open ground."""
    rmse = centimetres * vva.rmse_v
    if nva is None or vertical_class is None or _exceeds(centimetres * nva.rmse_v, vertical_class):
        return (
            f"The {_VVA} was found to be {_VERTICAL.symbol} = {_cm(rmse)} ({vva.errors.count} check points); it has no"
            " class without a non-vegetated accuracy that meets one."
        )
    return _asprs_text(vva.errors.count, rmse, vertical_class, _VERTICAL, f"The {_VVA}")


def _asprs_sentence(count: int, rmse: float, limit: float, kind: _AccuracyClass, subject: str) -> str:
    """Return the sentence for a tested accuracy in centimetres, or that it does not meet its class."""
    if _exceeds(rmse, limit):
        return (
            f"No statement: {kind.symbol} = {_cm(rmse)} does not meet the {_class(limit)} {kind.symbol} {kind.name}"
            f" ({count} check points)."
        )
    return _asprs_text(count, rmse, limit, kind, subject)


def _asprs_text(count: int, rmse: float, limit: float, kind: _AccuracyClass, subject: str) -> str:
    """Return the sentence of section 7.16 for a tested accuracy, in centimetres."""
    wanted, finding = f"{_class(limit)} {kind.symbol} {kind.name}", f"was found to be {kind.symbol} = {_cm(rmse)}"
    if count >= MIN_ASPRS_POINTS:
        return f"This data set was tested to meet {_EDITION} for a {wanted}. {subject} {finding}."
    return (
        f"This data set was tested as required by {_EDITION}. Although the Standards call for a minimum of thirty (30)"
        f" checkpoints, this test was performed using ONLY {count} checkpoints. This data set was produced to meet a"
        f" {wanted}. {subject} {finding} using the reduced number of checkpoints."
    )


def _smallest_class(rmse: float) -> float:
    """Return the smallest class of whole centimetres that a root mean square in centimetres meets."""
    return float(max(1, math.ceil(round(rmse, _ROUNDED_DIGITS))))


def _exceeds(rmse: float, limit: float) -> bool:
    return round(rmse, _ROUNDED_DIGITS) > limit


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
