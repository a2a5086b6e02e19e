"""Regions in the reference's frame: boxes, spheres, polygons, and their tests for points inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE, FloatArray
from pcbench.geometry.cloud import Cloud, as_cloud

Mask = NDArray[np.bool_]

AXES = "xyz"
_CHUNK_POINTS = 1 << 20  # points per polygon test, which bounds the memory


@runtime_checkable
class Region(Protocol):
    """A closed part of space: a `Box`, `Sphere`, `Polygon` or `Union`, or another class with the same methods."""

    @property
    def text(self) -> str:
        """The region as written on the command line, such as `box:0,0,0,1,1,1`, or else a readable name."""

    def contains(self, points: FloatArray) -> Mask:
        """Return the mask (N,) of the points (N, 3) inside or on the border."""

    def shifted(self, origin: FloatArray) -> Region:
        """Return the same region in coordinates from which `origin` (3,) has been subtracted."""

    def describe(self) -> str:
        """Return a readable name."""


@dataclass(frozen=True, eq=False)
class Box:
    """The points between two corners.

    Args:
        lower, upper: the corners (3,), in the reference's coordinates and unit.

    Raises:
        InputError: a corner is not three finite numbers, or lower > upper on an axis.
    """

    lower: FloatArray
    upper: FloatArray

    def __post_init__(self) -> None:
        lower, upper = _as_vector("lower corner", self.lower), _as_vector("upper corner", self.upper)
        for axis in np.flatnonzero(lower > upper):
            raise InputError(
                f"expected a box with lower <= upper, got {AXES[axis]} from {lower[axis]:.10g} to {upper[axis]:.10g}"
            )
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)

    @classmethod
    def around(cls, points: Cloud | ArrayLike) -> Box:
        """Return the bounding box of a cloud or of points (N, 3): `reference` on the command line."""
        return cls(*as_cloud(points).bounds)

    @property
    def text(self) -> str:
        """The box as written on the command line."""
        return _format_region("box", *self.lower, *self.upper)

    def contains(self, points: FloatArray) -> Mask:
        """Return the mask (N,) of the points (N, 3) inside or on the border."""
        inside = np.ones(len(points), dtype=np.bool_)
        for axis in range(3):  # one axis at a time: no (N, 3) temporaries
            inside &= _is_between(points[:, axis], self.lower[axis], self.upper[axis])
        return inside

    def shifted(self, origin: FloatArray) -> Box:
        """Return the box in coordinates from which `origin` (3,) has been subtracted."""
        return Box(self.lower - origin, self.upper - origin)

    def describe(self) -> str:
        """Return a readable name."""
        sides = zip(AXES, self.lower, self.upper, strict=True)
        return "box with " + ", ".join(f"{axis} from {low:.10g} to {high:.10g}" for axis, low, high in sides)

    def __repr__(self) -> str:
        return f"Box({self.lower.tolist()}, {self.upper.tolist()})"

    __str__ = describe


@dataclass(frozen=True, eq=False)
class Sphere:
    """The points within a distance of a centre.

    Args:
        center: (3,) in the reference's coordinates.
        radius: positive length in the reference's unit.

    Raises:
        InputError: the centre is not three finite numbers, or the radius is not positive and finite.
    """

    center: FloatArray
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", _as_vector("centre", self.center))
        radius = _as_array("the radius", self.radius)
        if radius.ndim or not 0 < radius < MAX_COORDINATE:
            raise InputError(f"expected a sphere with a positive, finite radius, got {self.radius}")
        object.__setattr__(self, "radius", float(radius))

    @classmethod
    def around(cls, points: Cloud | ArrayLike, quantile: float) -> Sphere:
        """Return the sphere about a cloud that contains a given share of its points: `quantile:q` on the command line.

        It suits clouds whose density decreases outwards. The centre is the median of each coordinate, so outliers do
        not move it.

        Args:
            points: a cloud, or points (N, 3).
            quantile: share of the points inside, in (0, 1]; the radius is this quantile of the distances to the centre.

        Raises:
            InputError: the quantile is outside (0, 1], or that share of the points lies at the centre.
        """
        if not 0 < quantile <= 1:
            raise InputError(f"expected a quantile in (0, 1], such as 0.99, got {quantile:g}")
        points = as_cloud(points).points
        center = np.median(points, axis=0)
        radius = float(np.quantile(_norms(points - center), quantile))
        if radius == 0:
            raise InputError(
                f"expected points around a centre, got a share of {quantile:g} of them at one position; use a larger"
                " quantile"
            )
        # Keeps the point that determines the radius inside when coordinates are shifted and rounded.
        return cls(center, radius * (1 + 1e-9))

    @property
    def text(self) -> str:
        """The sphere as written on the command line."""
        return _format_region("sphere", *self.center, self.radius)

    def contains(self, points: FloatArray) -> Mask:
        """Return the mask (N,) of the points (N, 3) inside or on the border."""
        return _norms(points - self.center) <= self.radius

    def shifted(self, origin: FloatArray) -> Sphere:
        """Return the sphere in coordinates from which `origin` (3,) has been subtracted."""
        return Sphere(self.center - origin, self.radius)

    def describe(self) -> str:
        """Return a readable name."""
        return f"sphere of radius {self.radius:.10g} about ({', '.join(f'{v:.10g}' for v in self.center)})"

    def __repr__(self) -> str:
        return f"Sphere({self.center.tolist()}, {self.radius})"

    __str__ = describe


@dataclass(frozen=True, eq=False)
class Polygon:
    """A prism: the points inside rings as seen along `axis` (even-odd rule), and between `lower` and `upper` along it.

    By the even-odd rule, a ring inside another one is a hole, and a ring beside it is a further part; the direction of
    rings does not matter. Points on a ring are inside; on a slanting edge this holds up to rounding.

    Args:
        rings: vertices (M, 2) of a ring, or a sequence of rings, closed or not. The columns are x, y for axis 2 (z);
            x, z for axis 1 (y); y, z for axis 0 (x).
        axis: direction of the prism: 0 (x), 1 (y) or 2 (z).
        lower, upper: ends of the prism along `axis`; -inf and inf for an unbounded prism.

    Raises:
        InputError: there is no ring, a ring has fewer than three distinct vertices or one that is not finite, `axis` is
            not 0, 1 or 2, or lower > upper.
    """

    rings: tuple[FloatArray, ...]
    axis: int = 2
    lower: float = -np.inf
    upper: float = np.inf
    # Set by `read_polygon`. `dataclasses.replace` resets it, since the result differs from the file.
    file: Path | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        rings = _as_rings(self.rings)
        if not rings:
            raise InputError("expected a polygon with at least one ring, got none")
        if self.axis not in (0, 1, 2):
            raise InputError(f"expected the axis of a polygon as 0, 1 or 2, got {self.axis}")
        if not self.lower <= self.upper:
            raise InputError(
                f"expected a polygon with lower <= upper along {AXES[self.axis]}, got {self.lower} and {self.upper}"
            )
        object.__setattr__(self, "rings", rings)

    @property
    def text(self) -> str:
        """The polygon as written on the command line if it comes from a file, else a readable name."""
        return self.describe() if self.file is None else f"polygon:{self.file}"

    @property
    def _plane(self) -> list[int]:
        return [axis for axis in range(3) if axis != self.axis]

    def contains(self, points: FloatArray) -> Mask:
        """Return the mask (N,) of the points (N, 3) inside or on the border."""
        first, second = self._plane
        low, high = np.vstack(self.rings).min(axis=0), np.vstack(self.rings).max(axis=0)
        inside = _is_between(points[:, self.axis], self.lower, self.upper)
        inside &= _is_between(points[:, first], low[0], high[0])
        inside &= _is_between(points[:, second], low[1], high[1])
        candidates = np.flatnonzero(inside)
        for start in range(0, len(candidates), _CHUNK_POINTS):
            chunk = candidates[start : start + _CHUNK_POINTS]
            inside[chunk] = _inside_rings(points[chunk, first], points[chunk, second], self.rings)
        return inside

    def shifted(self, origin: FloatArray) -> Polygon:
        """Return the polygon in coordinates from which `origin` (3,) has been subtracted."""
        along = float(origin[self.axis])
        rings = tuple(ring - origin[self._plane] for ring in self.rings)
        return Polygon(rings, self.axis, self.lower - along, self.upper - along)

    def describe(self) -> str:
        """Return a readable name."""
        plane = "".join(AXES[axis] for axis in self._plane)
        text = f"polygon of {sum(map(len, self.rings))} vertices in {plane}"
        if len(self.rings) > 1:
            text += f", {len(self.rings)} rings"
        if np.isfinite(self.lower) or np.isfinite(self.upper):
            text += f", {AXES[self.axis]} from {self.lower:.10g} to {self.upper:.10g}"
        return text

    def __repr__(self) -> str:
        return f"<{self.describe()}>"

    __str__ = describe


@dataclass(frozen=True, eq=False)
class Union:
    """The points inside any of several regions, such as the possibly overlapping polygons of a file."""

    regions: tuple[Region, ...]
    file: Path | None = field(default=None, init=False)  # as in `Polygon`

    def __post_init__(self) -> None:
        regions = tuple(self.regions)
        for region in regions:
            if not isinstance(region, Region):
                raise InputError(f"expected the parts of a union as regions, got {type(region).__name__}")
        object.__setattr__(self, "regions", regions)

    @property
    def text(self) -> str:
        """The union as written on the command line if it comes from a file, else a readable name."""
        return self.describe() if self.file is None else f"polygon:{self.file}"

    def contains(self, points: FloatArray) -> Mask:
        """Return the mask (N,) of the points (N, 3) inside or on the border of any region."""
        inside = np.zeros(len(points), dtype=np.bool_)
        for region in self.regions:
            inside |= region.contains(points)
        return inside

    def shifted(self, origin: FloatArray) -> Union:
        """Return the union in coordinates from which `origin` (3,) has been subtracted."""
        return Union(tuple(region.shifted(origin) for region in self.regions))

    def describe(self) -> str:
        """Return a readable name."""
        if len(self.regions) <= 3:
            return " and ".join(region.describe() for region in self.regions)
        return f"{len(self.regions)} regions, the first a {self.regions[0].describe()}"

    def __repr__(self) -> str:
        return f"<{self.describe()}>"

    __str__ = describe


# Text form


def _format_region(kind: str, *values: float) -> str:
    """Format a region with the shortest numbers that read back as the same float64."""
    return f"{kind}:" + ",".join(repr(float(value)).removesuffix(".0") for value in values)


# Conversion of callers' data


def _as_array(name: str, values: ArrayLike) -> FloatArray:
    """Copy an array, so that a region does not change with the caller's array."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"expected {name} as an array of numbers, got {type(values).__name__}: {error}") from error


def _as_vector(name: str, values: ArrayLike) -> FloatArray:
    array = _as_array(f"the {name}", values)
    if array.shape != (3,) or not (np.abs(array) < MAX_COORDINATE).all():
        raise InputError(f"expected the {name} as three finite numbers, got {array.tolist()}")
    return array


def _as_rings(vertices: Any) -> tuple[FloatArray, ...]:
    """Return a sequence of rings; the vertices of one ring become a single ring."""
    if isinstance(vertices, str) or not isinstance(vertices, Sequence | np.ndarray):
        return (_as_ring(vertices),)
    rings = list(vertices)
    if rings and isinstance(rings[0], Sequence | np.ndarray) and len(rings[0]) and np.isscalar(rings[0][0]):
        rings = [rings]
    return tuple(_as_ring(ring) for ring in rings)


def _as_ring(vertices: ArrayLike) -> FloatArray:
    array = _as_array("the ring of a polygon", vertices)
    if array.ndim != 2 or array.shape[1] != 2 or not (np.abs(array) < MAX_COORDINATE).all():
        raise InputError(f"expected the ring of a polygon as (M, 2) finite numbers, got shape {array.shape}")
    if len(array) > 1 and (array[0] == array[-1]).all():  # rings in files are closed
        array = array[:-1]
    if (distinct := len(np.unique(array, axis=0))) < 3:
        raise InputError(f"expected a polygon with at least 3 distinct vertices in each ring, got {distinct}")
    return array


# Geometry


def _is_between(values: FloatArray, lower: float, upper: float) -> Mask:
    result: Mask = values >= lower
    result &= values <= upper
    return result


def _norms(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vectors, vectors)), dtype=np.float64)


def _inside_rings(u: FloatArray, v: FloatArray, rings: tuple[FloatArray, ...]) -> Mask:
    """Return the mask of points (u, v), each (N,), inside the rings (even-odd rule) or on an edge."""
    # With points sorted by v, those level with an edge are one contiguous run, so an edge is only tested against these.
    order = np.argsort(v)
    u, v = u[order], v[order]
    begin, end = np.vstack(rings), np.vstack([np.roll(ring, -1, axis=0) for ring in rings])
    upwards = (begin[:, 1] <= end[:, 1])[:, None]
    low, high = np.where(upwards, begin, end), np.where(upwards, end, begin)
    # Points on an edge are searched in [low, high]. Crossings are counted in [low, high): once at a shared vertex.
    first, last = np.searchsorted(v, low[:, 1], "left"), np.searchsorted(v, high[:, 1], "right")
    half_open = np.searchsorted(v, high[:, 1], "left")

    odd, border = np.zeros((2, len(u)), dtype=np.bool_)
    for (u0, v0), (u1, v1), i, j, k in zip(low, high, first, half_open, last, strict=True):
        if i == k:
            continue
        # Positive if the point is left of the edge. Without a division it is exact on vertices and axis-parallel edges.
        side = (u1 - u0) * (v[i:k] - v0) - (v1 - v0) * (u[i:k] - u0)
        border[i:k] |= (side == 0) & _is_between(u[i:k], min(u0, u1), max(u0, u1))
        odd[i:j] ^= side[: j - i] > 0
    inside = np.empty_like(odd)
    inside[order] = odd | border
    return inside
