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
    open_ground: _Tested | None = None
    if (nva := accuracy.nva) is not None:
        tested = _Tested.of(centimetres * nva.rmse_v, settings.vertical_class)
        yield tested.sentence(nva.errors.count, _VERTICAL, f"The {_NVA}")
        if not tested.fails and (tested.is_named or nva.errors.count >= MIN_ASPRS_POINTS):
            open_ground = tested
    if (vva := accuracy.vva) is not None and open_ground is not None:
        vegetated = open_ground._replace(rmse=centimetres * vva.rmse_v)  # reported, whether it meets the class or not
        yield vegetated.text(vva.errors.count, _VERTICAL, f"The {_VVA}")
    elif vva is not None:
        yield (
            f"The {_VVA} was found to be {_VERTICAL.symbol} = {_cm(centimetres * vva.rmse_v)} ({vva.errors.count} check"
            " points); it has no class without a non-vegetated accuracy that meets one."
        )
    if (horizontal := accuracy.horizontal) is not None:
        tested = _Tested.of(centimetres * horizontal.rmse_h, settings.horizontal_class)
        yield tested.sentence(horizontal.x.count, _HORIZONTAL, "The tested horizontal positional accuracy")
    if settings.vertical_class is None and nva is not None:
        yield (
            "The vertical class is the smallest of whole centimetres that the result meets, or open (__): name that of"
            " the project with --vertical-class."
        )


class _Tested(NamedTuple):
    """A tested accuracy and its class, in centimetres, and whether the user named the class."""

    rmse: float
    limit: float
    is_named: bool

    @classmethod
    def of(cls, rmse: float, limit: float | None) -> _Tested:
        """Return an accuracy with the class that the user named, or the smallest that it meets."""
        return cls(rmse, _smallest_class(rmse) if limit is None else limit, limit is not None)

    @property
    def fails(self) -> bool:
        """Return whether the accuracy does not meet the class."""
        return round(self.rmse, _ROUNDED_DIGITS) > self.limit

    def sentence(self, count: int, kind: _AccuracyClass, subject: str) -> str:
        """Return the sentence of the standard, or that the class is not met."""
        if self.fails:
            return (
                f"No statement: {kind.symbol} = {_cm(self.rmse)} does not meet the {self.limit:g} (cm) {kind.symbol}"
                f" {kind.name} ({count} check points)."
            )
        return self.text(count, kind, subject)

    def text(self, count: int, kind: _AccuracyClass, subject: str) -> str:
        """Return the sentence of section 7.16.

        With fewer points than demanded, the class is that which the data were produced for, which no test tells.
        """
        finding = f"was found to be {kind.symbol} = {_cm(self.rmse)}"
        if count >= MIN_ASPRS_POINTS:
            wanted = f"{self.limit:g} (cm) {kind.symbol} {kind.name}"
            return f"This data set was tested to meet {_EDITION} for a {wanted}. {subject} {finding}."
        wanted = f"{f'{self.limit:g}' if self.is_named else '__'} (cm) {kind.symbol} {kind.name}"
        return (
            f"This data set was tested as required by {_EDITION}. Although the Standards call for a minimum of thirty"
            f" (30) checkpoints, this test was performed using ONLY {count} checkpoints. This data set was produced to"
            f" meet a {wanted}. {subject} {finding} using the reduced number of checkpoints."
        )


def _smallest_class(rmse: float) -> float:
    """Return the smallest class of whole centimetres that a root mean square in centimetres meets."""
    return float(max(1, math.ceil(round(rmse, _ROUNDED_DIGITS))))


def _cm(value: float) -> str:
    return f"{value:.1f} (cm)"


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
