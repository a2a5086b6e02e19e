"""The point cloud type: float64 points with optional normals, colours and named attributes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry import pyvista_points
from pcbench.geometry.arrays import MAX_COORDINATE, FloatArray, as_frozen, as_rows, bounds, freeze
from pcbench.geometry.quantisation import Quantisation

if TYPE_CHECKING:
    from pcbench.geometry.transform import Affine, Similarity


# Attributes of Gaussian splats that a change of frame invalidates: rotations, sizes and view-dependent colours.
_FRAME_DEPENDENT_PREFIXES = ("rot_", "scale_", "f_rest_")


class Storage(NamedTuple):
    """How a LAS file or its like stored a cloud: coordinates are integers times steps plus offsets.

    Attributes:
        steps: steps of x, y and z.
        offsets: offsets of x, y and z.
        color_depth: significant bits of the stored colours, 8 or 16; None without colours.
    """

    steps: tuple[float, float, float]
    offsets: tuple[float, float, float]
    color_depth: int | None = None


@dataclass(frozen=True, eq=False)
class Cloud:
    """A validated point cloud. Its arrays are read-only; later changes to the caller's arrays do not affect it.

    Args:
        points: (N, 3) finite coordinates, N >= 1, stored as C-contiguous float64.
        normals: (N, 3) directions of any length, or None.
        colors: (N, 3) RGB or None; whole numbers from 0 to 255 of any numeric type, stored as uint8.
        attributes: named numeric arrays (N,).
        crs: coordinate reference system as given by the file (WKT or authority code), or None.
        unit: unit of the coordinates ("m", "ft", ...), or None if unknown.
        stored: how the file stored the coordinates and colours, if it is a LAS file or its like. A LAS file is written
            with the same steps.

    Raises:
        InputError: a shape, a length or a value is not as described.
    """

    points: FloatArray
    normals: FloatArray | None = None
    colors: NDArray[np.uint8] | None = None
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    crs: str | None = None
    unit: str | None = None
    stored: Storage | None = None

    def __post_init__(self) -> None:
        points = _as_frozen_points("points", self.points)
        if not len(points):
            raise InputError("expected a point cloud with at least one point, got none")
        # One non-finite term makes the sum non-finite: one pass without a temporary mask is enough for most clouds.
        with np.errstate(over="ignore", invalid="ignore"):
            finite = bool(np.isfinite(points.sum()))
        if not finite and (bad := int(np.count_nonzero(~np.isfinite(points).all(axis=1)))):
            raise InputError(
                f"expected finite coordinates, got NaN or Inf in {bad} of {len(points)} points;"
                " drop them first, for example with pcbench.Cloud.from_finite"
            )
        if (largest := np.abs(bounds(points)).max()) > MAX_COORDINATE:
            raise InputError(f"expected coordinates up to {MAX_COORDINATE:g}, got {largest:g}; larger squares overflow")
        object.__setattr__(self, "points", points)
        if self.normals is not None:
            object.__setattr__(
                self, "normals", self._check_shape("normals", _as_frozen_points("normals", self.normals))
            )
        if self.colors is not None:
            object.__setattr__(
                self, "colors", self._check_shape("colors", _as_frozen_colors(self.colors), (len(points), 3))
            )
        if not isinstance(self.attributes, Mapping) or not all(isinstance(name, str) for name in self.attributes):
            raise InputError("expected attributes as a mapping from names to arrays")
        for name, text in (("crs", self.crs), ("unit", self.unit)):
            if not isinstance(text, str | None):
                raise InputError(f"expected {name} as text, got {type(text).__name__}")
        attributes = {name: as_frozen(np.asarray(values), values) for name, values in self.attributes.items()}
        for name, values in attributes.items():
            self._check_shape(f"attribute {name!r}", values, (len(points),))
        object.__setattr__(self, "attributes", attributes)

    def _check_shape(self, name: str, array: NDArray[Any], shape: tuple[int, ...] | None = None) -> NDArray[Any]:
        expected = shape or self.points.shape
        if array.shape != expected:
            raise InputError(f"expected {name} of shape {expected}, got {array.shape}")
        return array

    @classmethod
    def from_finite(cls, points: ArrayLike, **fields: Any) -> tuple[Cloud, int]:
        """Return a cloud of the points with finite coordinates, and the number of points dropped.

        Args:
            points: (N, 3) coordinates, some possibly NaN or Inf.
            **fields: other arguments of `Cloud`; arrays have one row for each of the N points.

        Raises:
            InputError: no point is finite, or a shape is wrong.
        """
        array = _as_frozen_points("points", points)
        with np.errstate(over="ignore", invalid="ignore"):
            if np.isfinite(array.sum()):
                return cls(array, **fields), 0
        keep: NDArray[np.bool_] = np.asarray(np.isfinite(array).all(axis=1))
        if not keep.any():
            raise InputError(f"expected at least one finite point, got NaN or Inf in all {len(array)} points")
        # Dropped points are set to the origin so that the fields are checked at their original length.
        checked = cls(freeze(np.where(keep[:, None], array, 0.0)), **fields)
        return checked.select(keep), int(len(array) - np.count_nonzero(keep))

    @classmethod
    def from_open3d(cls, cloud: Any) -> Cloud:
        """Copy an `open3d.geometry.PointCloud` or an `open3d.t.geometry.PointCloud`.

        Positions become float64. Colours from 0 to 1 become integers from 0 to 255. Other attributes of a tensor cloud
        are copied if they have one number per point.

        Raises:
            InputError: `cloud` is not an Open3D cloud, or its points are not a valid `Cloud`.
        """
        if hasattr(cloud, "point"):
            columns = {name: cloud.point[name].cpu().numpy() for name in cloud.point}
        elif hasattr(cloud, "points") and hasattr(cloud, "has_normals"):
            columns = {"positions": np.asarray(cloud.points)}
            columns |= {"normals": np.asarray(cloud.normals)} if cloud.has_normals() else {}
            columns |= {"colors": np.asarray(cloud.colors)} if cloud.has_colors() else {}
        else:
            raise InputError(f"expected an open3d PointCloud, got {type(cloud).__name__}")
        points, normals, colors = (columns.pop(name, None) for name in ("positions", "normals", "colors"))
        if points is None:
            raise InputError("expected a point cloud with at least one point, got none")
        if colors is not None and colors.dtype.kind == "f":
            colors = np.round(255 * colors)
        single = {name: values.ravel() for name, values in columns.items() if values.size == len(points)}
        return cls(points, normals, colors, single)

    def to_open3d(self) -> Any:
        """Copy to an `open3d.geometry.PointCloud` with points, normals, and colours from 0 to 1, without attributes.

        Raises:
            MissingExtra: Open3D is not installed.
        """
        open3d = require("open3d")
        vectors = open3d.utility.Vector3dVector  # copies only writable arrays
        cloud = open3d.geometry.PointCloud(vectors(self.points.copy()))
        if self.normals is not None:
            cloud.normals = vectors(self.normals.copy())
        if self.colors is not None:
            cloud.colors = vectors(self.colors / 255)
        return cloud

    def to_open3d_tensor(self) -> Any:
        """Copy to an `open3d.t.geometry.PointCloud` on the CPU.

        Positions and normals are float64, colours are uint8, and attributes are columns (N, 1).

        Raises:
            MissingExtra: Open3D is not installed.
        """
        open3d = require("open3d")
        columns = {"positions": self.points, "normals": self.normals, "colors": self.colors}
        columns |= {name: values[:, None] for name, values in self.attributes.items()}
        cloud = open3d.t.geometry.PointCloud()
        for name, values in columns.items():
            if values is not None:
                cloud.point[name] = open3d.core.Tensor.from_numpy(np.array(values, order="C"))
        return cloud

    @classmethod
    def from_trimesh(cls, geometry: Any) -> Cloud:
        """Copy a `trimesh.PointCloud`, or the vertices of a `trimesh.Trimesh`, with the colours.

        Raises:
            InputError: `geometry` is neither of them, or its points are not a valid `Cloud`.
        """
        if not hasattr(geometry, "vertices") or not hasattr(geometry, "visual"):
            kind = type(geometry).__name__
            raise InputError(f"expected a trimesh PointCloud or Trimesh, got {kind}; convert a Scene with to_mesh()")
        colors: Any = geometry.visual.vertex_colors if geometry.visual.kind == "vertex" else ()
        return cls(np.asarray(geometry.vertices), colors=colors[:, :3] if len(colors) else None)

    @classmethod
    def from_pyvista(cls, data: Any) -> Cloud:
        """Copy the points of a pyvista data set with their normals, colours and attributes; see `pyvista_points`.

        Raises:
            InputError: `data` has no points, or they are not a valid `Cloud`.
        """
        return cls(**pyvista_points.fields(data))

    def to_pyvista(self) -> Any:
        """Copy to a `pyvista.PolyData` with one vertex per point.

        Points stay float64. `Normals` are the active normals, `RGB` has the colours, attributes keep their names, and
        the coordinate system and the unit are field data, so that `from_pyvista` restores an equal cloud.

        Raises:
            MissingExtra: pyvista is not installed.
            InputError: an attribute is called Normals or RGB.
        """
        data = require("pyvista").PolyData(self.points.copy())
        pyvista_points.add(data, self.normals, self.colors, self.attributes, crs=self.crs, unit=self.unit)
        return data

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        parts = [name for name in ("normals", "colors") if getattr(self, name) is not None]
        parts += list(self.attributes)
        return f"Cloud({len(self)} points{', ' + ', '.join(parts) if parts else ''})"

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner of the bounding box, each (3,)."""
        return bounds(self.points)

    @property
    def centre(self) -> tuple[float, float]:
        """Middle of the ranges of x and y."""
        low, high = self.bounds
        return float(low[0] / 2 + high[0] / 2), float(low[1] / 2 + high[1] / 2)

    @cached_property
    def quantisation(self) -> Quantisation:
        """Lattice on which the coordinates lie because a file rounded them."""
        return Quantisation.of(self.points)

    def select(self, which: NDArray[Any]) -> Cloud:
        """Return the points selected by a boolean mask (N,) or by indices (M,)."""
        return replace(
            self,
            points=freeze(self.points[which]),
            normals=None if self.normals is None else freeze(self.normals[which]),
            colors=None if self.colors is None else freeze(self.colors[which]),
            attributes={name: freeze(values[which]) for name, values in self.attributes.items()},
        )

    def transformed(self, transform: Similarity | Affine) -> Cloud:
        """Return the cloud in another frame.

        The rotations, scales and view-dependent colours of Gaussian splats are dropped, since they are only valid in
        the old frame.
        """
        normals = None if self.normals is None else freeze(transform.apply_normals(self.normals))
        return self.moved(freeze(transform.apply(self.points)), normals)

    def moved(self, points: FloatArray, normals: FloatArray | None = None) -> Cloud:
        """Return the cloud at other positions (N, 3), as `transformed` does."""
        kept_attributes = {
            name: a for name, a in self.attributes.items() if not name.startswith(_FRAME_DEPENDENT_PREFIXES)
        }
        return replace(self, points=points, normals=normals, attributes=kept_attributes, stored=None)


def as_cloud(data: Cloud | ArrayLike) -> Cloud:
    """Return `data` itself if it is a `Cloud`, else a cloud of points (N, 3)."""
    return data if isinstance(data, Cloud) else Cloud(_as_frozen_points("points", data))


def _as_frozen_points(name: str, data: ArrayLike) -> FloatArray:
    return as_frozen(as_rows(name, data), data)


def _as_frozen_colors(data: ArrayLike) -> NDArray[np.uint8]:
    array = np.asarray(data)
    if array.dtype == np.uint8:
        return as_frozen(np.ascontiguousarray(array), data)
    # A plain cast would turn floats from 0 to 1 into black, and would wrap 256 round to 0.
    if array.dtype.kind not in "iuf" or not ((array >= 0) & (array <= 255) & (array == array.round())).all():
        raise InputError(f"expected colors as whole numbers 0 to 255, got {type(data).__name__} of {array.dtype}")
    return freeze(np.ascontiguousarray(array, dtype=np.uint8))
