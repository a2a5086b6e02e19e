"""The one point cloud type: float64 points with optional normals, colours and named attributes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.arrays import MAX_COORDINATE, FloatArray, as_rows, bounds, freeze, kept

if TYPE_CHECKING:
    from pcbench.geometry.transform import Affine, Similarity


# Per-point quantities of a Gaussian splat that live in its own axes: a change of frame makes them wrong.
_FRAME_BOUND = ("rot_", "scale_", "f_rest_")


@dataclass(frozen=True, eq=False)
class Cloud:
    """A point cloud, checked once at birth. Its arrays are read-only, and no later change to a given array reaches it.

    Args:
        points: (N, 3) finite coordinates, N >= 1, kept as C-contiguous float64.
        normals: (N, 3) directions (unit length is the writer's business) or None.
        colors: (N, 3) RGB or None, whole numbers 0 to 255 of any type, kept as uint8.
        attributes: named (N,) arrays of numbers.
        crs: coordinate reference system as given by the file (WKT or authority code), if any.
        unit: unit of the coordinates ("m", "ft", ...), if known.

    Raises:
        InputError: a shape, a length or a value is not as described.
    """

    points: FloatArray
    normals: FloatArray | None = None
    colors: NDArray[np.uint8] | None = None
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    crs: str | None = None
    unit: str | None = None

    def __post_init__(self) -> None:
        points = _triples("points", self.points)
        if not len(points):
            raise InputError("expected a point cloud with at least one point, got none")
        # The sum is non-finite whenever a term is: one pass without a temporary mask decides the usual case.
        with np.errstate(over="ignore", invalid="ignore"):
            finite = bool(np.isfinite(points.sum()))
        if not finite and (bad := int(np.count_nonzero(~np.isfinite(points).all(axis=1)))):
            raise InputError(
                f"expected finite coordinates, got NaN or Inf in {bad} of {len(points)} points:"
                " drop them first (pcbench.Cloud.from_finite does)"
            )
        if (largest := np.abs(bounds(points)).max()) > MAX_COORDINATE:
            raise InputError(f"expected coordinates up to {MAX_COORDINATE:g}, got {largest:g}: squares overflow")
        object.__setattr__(self, "points", points)
        if self.normals is not None:
            object.__setattr__(self, "normals", self._matching("normals", _triples("normals", self.normals)))
        if self.colors is not None:
            object.__setattr__(self, "colors", self._matching("colors", _bytes(self.colors), (len(points), 3)))
        if not isinstance(self.attributes, Mapping) or not all(isinstance(name, str) for name in self.attributes):
            raise InputError("expected attributes as a mapping from names to arrays")
        for what, text in (("crs", self.crs), ("unit", self.unit)):
            if not isinstance(text, str | None):
                raise InputError(f"expected {what} as text, got {type(text).__name__}")
        attributes = {name: kept(np.asarray(values), values) for name, values in self.attributes.items()}
        for name, values in attributes.items():
            self._matching(f"attribute {name!r}", values, (len(points),))
        object.__setattr__(self, "attributes", attributes)

    def _matching(self, what: str, array: NDArray[Any], shape: tuple[int, ...] | None = None) -> NDArray[Any]:
        expected = shape or self.points.shape
        if array.shape != expected:
            raise InputError(f"expected {what} of shape {expected}, got {array.shape}")
        return array

    @classmethod
    def from_finite(cls, points: ArrayLike, **fields: Any) -> tuple[Cloud, int]:
        """A cloud of the points whose coordinates are finite, and how many were dropped.

        Raises:
            InputError: no point is finite, or a shape is wrong.
        """
        array = _triples("points", points)
        with np.errstate(over="ignore", invalid="ignore"):
            if np.isfinite(array.sum()):
                return cls(array, **fields), 0
        keep: NDArray[np.bool_] = np.asarray(np.isfinite(array).all(axis=1))
        if not keep.any():
            raise InputError(f"all {len(array)} points are NaN or Inf")
        # With the dropped points at the origin the fields are checked against the points they came with.
        checked = cls(freeze(np.where(keep[:, None], array, 0.0)), **fields)
        return checked.select(keep), int(len(array) - np.count_nonzero(keep))

    @classmethod
    def from_open3d(cls, cloud: Any) -> Cloud:
        """A copy of an `open3d.geometry.PointCloud` or an `open3d.t.geometry.PointCloud`.

        Positions become float64; colours, which Open3D may hold as 0 to 1, become whole numbers 0 to 255. Of a tensor's
        other attributes those with one number a point are taken.

        Raises:
            InputError: it is neither, or is no valid cloud: see `Cloud`.
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
        """A copy as an `open3d.geometry.PointCloud`: points, normals, and colours as 0 to 1. It has no attributes.

        Raises:
            MissingExtra: Open3D is not installed.
        """
        open3d = require("open3d")
        vectors = open3d.utility.Vector3dVector  # copies, but only what it could change
        cloud = open3d.geometry.PointCloud(vectors(self.points.copy()))
        if self.normals is not None:
            cloud.normals = vectors(self.normals.copy())
        if self.colors is not None:
            cloud.colors = vectors(self.colors / 255)
        return cloud

    def to_open3d_tensor(self) -> Any:
        """A copy as an `open3d.t.geometry.PointCloud` on the CPU: float64 positions and normals, uint8 colours, and the
        attributes as columns (N, 1).

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
        """A copy of a `trimesh.PointCloud`, or of the vertices of a `trimesh.Trimesh`, with their colours.

        Raises:
            InputError: it is neither, or is no valid cloud: see `Cloud`.
        """
        if not hasattr(geometry, "vertices") or not hasattr(geometry, "visual"):
            what = type(geometry).__name__
            raise InputError(f"expected a trimesh PointCloud or Trimesh, got {what}: a Scene has to_mesh()")
        colors: Any = geometry.visual.vertex_colors if geometry.visual.kind == "vertex" else ()
        return cls(np.asarray(geometry.vertices), colors=colors[:, :3] if len(colors) else None)

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

    def select(self, which: NDArray[Any]) -> Cloud:
        """The points picked by a boolean mask (N,) or by indices (M,)."""
        return replace(
            self,
            points=freeze(self.points[which]),
            normals=None if self.normals is None else freeze(self.normals[which]),
            colors=None if self.colors is None else freeze(self.colors[which]),
            attributes={name: freeze(values[which]) for name, values in self.attributes.items()},
        )

    def transformed(self, transform: Similarity | Affine) -> Cloud:
        """The cloud in another frame. Gaussian rotations, scales and view-dependent colours do not survive it."""
        normals = None if self.normals is None else freeze(transform.apply_normals(self.normals))
        kept = {name: a for name, a in self.attributes.items() if not name.startswith(_FRAME_BOUND)}
        return replace(self, points=freeze(transform.apply(self.points)), normals=normals, attributes=kept)


def as_cloud(data: Cloud | ArrayLike) -> Cloud:
    """A `Cloud` as it is, or one around an (N, 3) array."""
    return data if isinstance(data, Cloud) else Cloud(_triples("points", data))


def _triples(what: str, data: ArrayLike) -> FloatArray:
    return kept(as_rows(what, data), data)


def _bytes(data: ArrayLike) -> NDArray[np.uint8]:
    array = np.asarray(data)
    if array.dtype == np.uint8:
        return kept(np.ascontiguousarray(array), data)
    # A cast alone would turn 0..1 floats into black and let 256 wrap round to 0.
    if array.dtype.kind not in "iuf" or not ((array >= 0) & (array <= 255) & (array == array.round())).all():
        raise InputError(f"expected colors as whole numbers 0 to 255, got {type(data).__name__} of {array.dtype}")
    return freeze(np.ascontiguousarray(array, dtype=np.uint8))
