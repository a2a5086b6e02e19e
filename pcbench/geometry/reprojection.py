"""Transform a cloud to another coordinate reference system."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.area import area_warning, covered_area
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import (
    axis_lengths,
    axis_units,
    crs_name,
    horizontal_crs,
    known_crs,
    single_unit,
    with_ellipsoidal_heights,
    with_units,
)
from pcbench.geometry.units import metres

Warn = Callable[[str], None]
_Area = tuple[float, float, float, float]


class ProjectedCloud(NamedTuple):
    """A cloud in another CRS, and the operation that transformed it.

    Attributes:
        cloud: the cloud.
        operation: name of the operation, as PROJ composes it.
        accuracy: accuracy of the operation in metres, as its authority states it; 0 for a conversion within one datum;
            None if it is unknown.
    """

    cloud: Cloud
    operation: str
    accuracy: float | None


def project(
    cloud: Cloud, target: str, on_warning: Warn | None = None, *, accuracy: float | None = None
) -> ProjectedCloud:
    """Return a cloud in another CRS, with its attributes and colours, without normals.

    If the target has heights, or those of the cloud are ellipsoidal, x, y and z are transformed together. Otherwise x
    and y are transformed; heights keep their datum and are converted to the unit of the new CRS.

    The most accurate operation for the area of the cloud is used. A ballpark operation, which neglects a difference of
    datums, never is.

    Args:
        cloud: the cloud.
        target: the new CRS, projected or geographic, such as "EPSG:32617", or "EPSG:32617+5703" with heights.
        on_warning: called with one line for each loss of accuracy or of normals.
        accuracy: an operation that is stated to be this accurate, in metres, may be used if the grid of the most
            accurate one is not installed.

    Raises:
        InputError: a CRS is unknown or does not suit, the datum of the heights is unknown but needed, no operation is
            known, its grid is not installed, or points lie outside the area of the new CRS.
        MissingExtra: pyproj is not installed.
    """
    warn = on_warning or (lambda _: None)
    new = known_crs(target)
    if cloud.crs is None:
        raise InputError("expected a cloud with a coordinate system, got none: state it with --crs, such as EPSG:4326")
    source = known_crs(cloud.crs)
    _check_suitable(source, new, target)
    heights, new_heights = _Heights.of(source), _Heights.of(new)
    if new_heights.is_known and not heights.is_known:
        raise InputError(
            f"expected heights whose datum is known, to transform them to {crs_name(target)}, got"
            f" {crs_name(cloud.crs)}: state the system with its heights, such as --crs"
            f" {_examples(cloud.crs)}; or name the system of x and y alone, and heights keep their datum"
        )
    area = covered_area(cloud.crs, cloud.points)
    if heights.is_ellipsoidal or new_heights.is_known:
        crs = target if new_heights.is_known else _with_own_heights(target)
        operation = _operation(source, known_crs(crs), crs_name(target), area, accuracy)
        points = np.stack(operation.transform(*cloud.points.T), axis=1)
    else:
        crs = target if heights.unit is None else _with_heights(target, cloud.crs)
        operation = _operation(horizontal_crs(source), new, crs_name(target), area, accuracy)
        lengths, new_lengths = axis_lengths(cloud.crs), axis_lengths(target)
        assert lengths is not None and new_lengths is not None
        x, y, z = cloud.points.T
        points = np.stack([*operation.transform(x, y), z * (lengths[1] / new_lengths[1])], axis=1)
    if outside := int(np.count_nonzero(~np.isfinite(points).all(axis=1))):
        raise InputError(
            f"expected points in the area of {crs_name(target)}, got {outside} of {len(points)} outside of it: choose"
            " another system"
        )
    for line in (*_epoch_warnings(source, new), area_warning(crs, points)):
        if line:
            warn(line)
    if cloud.normals is not None:
        warn("left out normals, which have other directions in the new system")
    moved = replace(cloud.moved(points), crs=crs, unit=single_unit(crs, warn))
    steps = [step for step in operation.description.split(" + ") if not step.startswith("axis order change")]
    name = " + ".join(steps) or "no change"
    return ProjectedCloud(moved, name, operation.accuracy if operation.accuracy >= 0 else None)


class _Heights(NamedTuple):
    """Heights of a CRS: their unit, None without heights; whether they are ellipsoidal, or their datum is known."""

    unit: str | None
    is_ellipsoidal: bool
    is_known: bool

    @classmethod
    def of(cls, crs: Any) -> _Heights:
        if crs.sub_crs_list:
            heights = crs.sub_crs_list[1]
            return cls(heights.axis_info[0].unit_name, False, str(heights.datum and heights.datum.name) != "unknown")
        is_ellipsoidal = len(crs.axis_info) == 3
        return cls(crs.axis_info[2].unit_name if is_ellipsoidal else None, is_ellipsoidal, is_ellipsoidal)


def _check_suitable(source: Any, new: Any, target: str) -> None:
    if not (new.is_projected or new.is_geographic):
        raise InputError(
            f"expected a projected or geographic coordinate system, such as EPSG:32617, got {crs_name(target)}: choose"
            " another system"
        )
    if horizontal_crs(source).is_engineering:
        raise InputError(
            "expected a coordinate system with a place on Earth, got one of which only the units are known: state it"
            " with --crs"
        )


def _examples(crs: str) -> str:
    """Return a CRS without heights with those of two kinds, as examples for a command."""
    ellipsoidal, system = crs_name(with_ellipsoidal_heights(crs)), crs_name(crs)
    levelled = f"{system}+5703 (NAVD88)"
    return f"{ellipsoidal} (ellipsoidal) or {levelled}" if ellipsoidal.startswith("EPSG:") else levelled


def _with_own_heights(target: str) -> str:
    """Return a CRS with heights above its ellipsoid, in the unit of x and y if these are lengths."""
    crs, units = with_ellipsoidal_heights(target), axis_units(target)
    return with_units(crs, units.horizontal, None) if units is not None and metres(units.horizontal) != 1 else crs


def _operation(source: Any, target: Any, name: str, area: _Area | None, accuracy: float | None) -> Any:
    """Return the `pyproj.Transformer` of the most accurate operation for an area.

    Args:
        source: CRS of the cloud.
        target: the new CRS.
        name: name of the new CRS, for messages.
        area: west, south, east and north of the cloud, in degrees.
        accuracy: accuracy of a replacement that the user accepts, in metres.

    Raises:
        InputError: no operation is known, or its grid is not installed.
    """
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pyproj about grids, which the error below names
        group = TransformerGroup(
            source,
            target,
            always_xy=True,
            area_of_interest=None if area is None else AreaOfInterest(*area),
            allow_ballpark=False,
        )
    if group.transformers and group.best_available:
        return group.transformers[0]
    usable = [item for item in group.transformers if accuracy is not None and 0 <= item.accuracy <= accuracy]
    if usable:
        return usable[0]
    if not group.unavailable_operations:
        place = "" if area is None else f" at longitude {area[0]:.4g}, latitude {area[1]:.4g}"
        raise InputError(
            f"expected a coordinate system to which PROJ knows a transformation{place}, got {name}: choose another, or"
            " go through a third"
        )
    best = group.unavailable_operations[0]
    grids = [grid for grid in best.grids if not grid.available] or list(best.grids)
    files = ", ".join(grid.short_name for grid in grids)
    commands = " && ".join(f"pyproj sync --file {grid.short_name}" for grid in grids if grid.url)
    remedy = f"install with {commands}" if commands else "which PROJ does not distribute: get it from its agency"
    others = [item.accuracy for item in group.transformers if item.accuracy >= 0]
    accept = f", or accept an accuracy of {others[0]:g} m with --accuracy {others[0]:g}" if others else ""
    stated = f" of {best.accuracy:.3g} m accuracy" if best.accuracy >= 0 else ""
    raise InputError(
        f"the transformation{stated} to {name} needs {'grids that are' if len(grids) > 1 else 'a grid that is'} not"
        f" installed, {files}: {remedy}{accept}"
    )


def _epoch_warnings(source: Any, target: Any) -> Iterator[str]:
    """Yield a warning if two datums differ and one of them moves relative to the plates."""
    frames = [
        crs.geodetic_crs.datum.to_json_dict() for crs in (source, target) if crs.geodetic_crs and crs.geodetic_crs.datum
    ]
    epochs = [frame.get("frame_reference_epoch") for frame in frames]
    if len({frame["name"] for frame in frames}) == 2 and any(epoch is not None for epoch in epochs):
        first, second = (
            f"{frame['name']}{'' if epoch is None else f' (epoch {epoch:g})'}"
            for frame, epoch in zip(frames, epochs, strict=True)
        )
        yield (
            f"transformed from {first} to {second} as if measured at the reference epoch: in a dynamic datum,"
            " coordinates move by centimetres a year"
        )


def _with_heights(target: str, source: str) -> str:
    """Return the CRS of a target with the vertical CRS of a source, in the unit of the target; codes if both have one.

    The unit is that of x and y, or metres if these are degrees.
    """
    from pyproj import CRS

    units = axis_units(target)
    unit = units.horizontal if units is not None and metres(units.horizontal) else "m"
    parts = [horizontal_crs(known_crs(target)), known_crs(with_units(source, "m", unit)).sub_crs_list[1]]
    codes = [part.to_epsg(min_confidence=100) for part in parts]
    if all(codes):
        return f"EPSG:{codes[0]}+{codes[1]}"
    values = {"type": "CompoundCRS", "name": " + ".join(part.name for part in parts)}
    return str(CRS.from_json_dict(values | {"components": [part.to_json_dict() for part in parts]}).to_wkt())
