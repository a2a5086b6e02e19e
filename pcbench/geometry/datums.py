"""Names of a coordinate system, its units and its datums, for reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pcbench.geometry.crs import axis_units, crs_label, horizontal_crs, parse_crs

_UNKNOWN_DATUM = "unknown"


@dataclass(frozen=True)
class StatedSystem:
    """Coordinate system of a file, as it states it.

    Attributes:
        crs: name and authority code; None if the file states none.
        unit: unit of x and y, if known.
        z_unit: unit of z, if known.
        horizontal_datum: name of the datum of x and y, if known.
        vertical_datum: name of the datum of z, "ellipsoidal heights" or "geocentric coordinates"; None if not stated.
    """

    crs: str | None = None
    unit: str | None = None
    z_unit: str | None = None
    horizontal_datum: str | None = None
    vertical_datum: str | None = None

    @classmethod
    def of(cls, crs: str | None, unit: str | None) -> StatedSystem:
        """Return the system of a CRS, or of coordinates in a unit. Without pyproj, the datums are unknown."""
        system, units = None if crs is None else parse_crs(crs), axis_units(crs)
        label = None if crs is None else crs_label(crs)
        if system is None or units is None:
            return cls(label, unit, unit)
        z_unit = units.height or (None if horizontal_crs(system).is_geographic else units.horizontal)
        return cls(label, units.horizontal, z_unit, _horizontal_datum(system), _vertical_datum(system))

    def describe(self) -> str:
        """Return the system, its units and its datums in words."""
        name = "coordinate system not stated" if self.crs is None else self.crs
        if self.unit is None:
            units = "unit not stated"
        elif self.z_unit in (None, self.unit):
            units = f"{'x and y ' if self.z_unit is None else ''}in {self.unit}"
        else:
            units = f"x and y in {self.unit}, z in {self.z_unit}"
        return f"{name}, {units}{'' if self.crs is None else f'; {self.describe_datums()}'}"

    def describe_datums(self) -> str:
        """Return the datums in words."""
        if self.horizontal_datum is None and self.vertical_datum is None:
            return "datums unknown"
        horizontal = "datum unknown" if self.horizontal_datum is None else f"datum {self.horizontal_datum}"
        if self.vertical_datum is None:
            return f"{horizontal}, vertical datum not stated"
        is_datum = self.vertical_datum not in ("ellipsoidal heights", "geocentric coordinates")
        return f"{horizontal}, {'heights above ' if is_datum else ''}{self.vertical_datum}"


def _horizontal_datum(crs: Any) -> str | None:
    datum = None if horizontal_crs(crs).is_engineering else horizontal_crs(crs).datum
    return None if datum is None else str(datum.name)


def _vertical_datum(crs: Any) -> str | None:
    if crs.is_geocentric:
        return "geocentric coordinates"
    if crs.sub_crs_list:
        datum = crs.sub_crs_list[1].datum
        return None if datum is None or datum.name == _UNKNOWN_DATUM else str(datum.name)
    is_ellipsoidal = len(crs.axis_info) == 3 and not crs.is_engineering
    return "ellipsoidal heights" if is_ellipsoidal else None
