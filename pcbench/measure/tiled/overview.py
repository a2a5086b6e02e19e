"""Overview of a deviation map: distances per pixel of a raster, seen from above. Comparisons in memory have it too."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.voxels import robust_bounds
from pcbench.io.map_tiles import MapOverview
from pcbench.measure.tiled.sums import Groups, GroupSums, unsummable
from pcbench.native import _core

_PIXELS_ALONG = 1_000  # at most, along the longer side of the overview
_SPACINGS_PER_PIXEL = 2.5  # at least: most pixels of a surface then hold points
_MAX_HORIZONTAL_NZ = math.sin(math.radians(10))  # |z| of a normal that is nearly horizontal
_BORDER_SHARE = 0.05  # of the robust bounds, beyond which points are outliers


@dataclass(frozen=True)
class PixelGrid:
    """A raster over the two horizontal axes, in local coordinates.

    Attributes:
        west, south: lower left corner.
        pixel: edge of a pixel.
        width, height: number of pixels.
    """

    west: float
    south: float
    pixel: float
    width: int
    height: int

    @classmethod
    def covering(cls, even: FloatArray, low: FloatArray, high: FloatArray, spacing: float) -> PixelGrid:
        """Return a raster over a cloud without far outliers, with pixels that hold several points.

        Args:
            even: (M, 3) evenly thinned cloud.
            low: (3,) lowest corner of its box.
            high: (3,) highest corner.
            spacing: its median point spacing.
        """
        inner_low, inner_high = robust_bounds(even)
        border = _BORDER_SHARE * (inner_high - inner_low)
        low, high = np.maximum(low, inner_low - border)[:2], np.minimum(high, inner_high + border)[:2]
        length = max(float((high - low).max()) / _PIXELS_ALONG, _SPACINGS_PER_PIXEL * spacing)
        pixel = _round_length(length) if length > 0 else 1.0
        west, south = (math.floor(float(corner) / pixel) * pixel for corner in low)
        width, height = (
            max(1, math.ceil((float(end) - start) / pixel)) for end, start in zip(high, (west, south), strict=True)
        )
        return cls(west, south, pixel, width, height)

    def pixels_of(self, points: FloatArray) -> IntArray:
        """Return the number of the pixel of each point (N, 3), row by row from the south; -1 outside."""
        column = np.floor((points[:, 0] - self.west) / self.pixel)
        row = np.floor((points[:, 1] - self.south) / self.pixel)
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        numbers: IntArray = np.where(inside, row * self.width + column, -1).astype(np.int64)
        return numbers


@dataclass(frozen=True, eq=False)
class PixelSums:
    """Sums of the distances of a part of a map per pixel.

    Attributes:
        sums: sum of the distances in each pixel that has points, as `distance`.
        largest: (K,) largest distance in each of these pixels.
        signed: sum of the known signed distances in each pixel that has some, as `signed`.
    """

    sums: GroupSums
    largest: FloatArray
    signed: GroupSums

    @classmethod
    def of(cls, grid: PixelGrid, points: FloatArray, distances: FloatArray, signed: FloatArray) -> PixelSums:
        """Add up distances (N,) of points (N, 3), and signed ones (N,), which are NaN where they are unknown."""
        pixels = grid.pixels_of(points)
        inside = np.flatnonzero(pixels >= 0)
        pixels, distances, signed = pixels[inside], distances[inside], signed[inside]
        groups = Groups.of(pixels)
        sums, largest = GroupSums.of(groups, {"distance": distances}), _largest(groups, distances)
        is_known = np.isfinite(signed)
        if not is_known.all():
            groups, signed = Groups.of(pixels[is_known]), signed[is_known]
        return cls(sums, largest, GroupSums.of(groups, {"signed": signed}))


class OverviewSums:
    """Sums of the distances of all parts of a map per pixel of a grid; each part changes only its own pixels.

    Args:
        grid: the grid.
    """

    def __init__(self, grid: PixelGrid) -> None:
        self._grid, count = grid, grid.width * grid.height
        self._sums, self._signed = (GroupSums.empty(count, [name]) for name in ("distance", "signed"))
        self._largest = np.zeros(count)

    def add(self, part: PixelSums) -> None:
        """Add the sums of a part."""
        self._sums.add(part.sums)
        self._signed.add(part.signed)
        keys = part.sums.keys
        self._largest[keys] = np.maximum(self._largest[keys], part.largest)

    def add_points(self, points: FloatArray, distances: FloatArray, signed: FloatArray) -> None:
        """Add the sums of points (N, 3), as `PixelSums.of` computes them.

        Args:
            points: (N, 3) points.
            distances: (N,) their distances.
            signed: (N,) their signed distances, NaN where they are unknown.

        Raises:
            InputError: a distance is not finite, or not below 2^96 (8e28).
        """
        grid, sums, signed_sums = self._grid, self._sums, self._signed
        if not _core.add_to_pixels(
            np.ascontiguousarray(points),
            distances,
            signed,
            grid.west,
            grid.south,
            grid.pixel,
            grid.width,
            grid.height,
            sums.counts,
            sums.limbs["distance"],
            self._largest,
            signed_sums.counts,
            signed_sums.limbs["signed"],
        ):
            raise unsummable("distance", distances)

    def overview(self, origin: FloatArray) -> MapOverview:
        """Return the raster, in coordinates to which `origin` (3,) was added."""
        grid, counts = self._grid, self._sums.counts
        shape = (grid.height, grid.width)
        with np.errstate(invalid="ignore"):  # 0 / 0 is NaN: there are no points
            signed, mean = self._signed.means("signed"), self._sums.means("distance")
        largest = np.where(counts > 0, self._largest, np.nan)
        west, north = grid.west + float(origin[0]), grid.south + grid.height * grid.pixel + float(origin[1])
        signed, mean, largest = (values.reshape(shape)[::-1] for values in (signed, mean, largest))
        return MapOverview(signed, mean, largest, counts.reshape(shape)[::-1], west, north, grid.pixel)


def along_upward_normals(planes: FloatArray, normals: FloatArray) -> FloatArray:
    """Return signed distances (N,) along normals (N, 3) with those that point downwards reversed.

    A given normal that is horizontal, within ten degrees, stays: it says which side of a wall is its front.
    """
    return np.where(normals[:, 2] < -_MAX_HORIZONTAL_NZ, -planes, planes)


def _largest(groups: Groups, values: FloatArray) -> FloatArray:
    largest = np.full(len(groups.keys), -np.inf)
    np.maximum.at(largest, groups.of_value, values)
    return largest


def _round_length(length: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is at least as long."""
    power = 10.0 ** math.floor(math.log10(length))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= length * (1 - 1e-9))
