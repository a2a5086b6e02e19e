"""M3C2 as a comparison takes it: explicit settings, or lengths that follow the spacing; core points from anywhere."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcbench.errors import InputError, Notice
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, unit
from pcbench.geometry.voxels import voxel_downsample_to
from pcbench.measure.deviation import M3C2, m3c2
from pcbench.registration import Registration

if TYPE_CHECKING:
    from pcbench.measure.reference import Reference

_MAX_CORES = 50_000  # where none are given: the reference, voxel-downsampled
_CYLINDER_RADIUS = 6  # median spacings of the sparser cloud: about 30 of its points a cylinder
_CYLINDER_REACH = 1  # radii to either side: farther ones meet the other side of a house
_MIN_PLANE = 3  # points that a normal is estimated from


@dataclass(frozen=True, eq=False)
class M3C2Settings:
    """What M3C2 is computed with (Lague, Brodu & Leroux 2013, section 3); lengths in the clouds' unit.

    Attributes:
        radius: of the cylinders: half of the paper's projection scale d. None: 6 median spacings of the sparser cloud.
        depth: how far the cylinders reach to either side of a core point. None: the radius.
        normal_radius: of the ball about a core point whose reference points its normal is fitted to: half of the
            paper's normal scale D. Signs are those of the reference's normals, upwards where it came without. None:
            normals that come with the core points, else those of the reference at the point nearest to each.
        cores: the core points, in the reference's coordinates: a file, a cloud or an (N, 3) array. None: the
            reference's points, half a radius apart.
        registration_error: the paper's reg, added to the level of detection. None: what the registration predicts.

    Raises:
        InputError: a value is not usable.
    """

    radius: float | None = None
    depth: float | None = None
    normal_radius: float | None = None
    cores: Any = None
    registration_error: float | None = None

    def __post_init__(self) -> None:
        for name in ("radius", "depth", "normal_radius", "registration_error"):
            value = getattr(self, name)
            if value is None:
                continue
            is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            least = "a number of at least 0" if name == "registration_error" else "a positive number"
            if not is_number or not np.isfinite(value) or value < 0 or (value == 0 and name != "registration_error"):
                raise InputError(f"expected M3C2's {name} as {least}, got {value!r}")
        if isinstance(self.cores, str | PathLike):  # read when it is needed
            object.__setattr__(self, "cores", Path(self.cores))
        elif self.cores is not None:
            object.__setattr__(self, "cores", as_cloud(self.cores))

    @classmethod
    def parse(cls, text: str) -> M3C2Settings:
        """What `radius=0.5,depth=2,cores=FILE` stands for: names of the attributes, each at most once.

        Raises:
            InputError: a name is unknown or said twice, or a value is not usable.
        """
        names = [item.name for item in fields(cls)]
        values: dict[str, Any] = {}
        for part in re.split(r",(?=\s*[\w-]+=)", text):  # a file's name may hold commas
            name, equals, value = (piece.strip() for piece in part.partition("="))
            if not equals or name not in names:
                raise InputError(f"M3C2: expected NAME=VALUE with a name of {', '.join(names)}, got {part.strip()!r}")
            if name in values:
                raise InputError(f"M3C2: {name} is given twice")
            if not value:
                raise InputError(f"M3C2: expected a value after {name}=")
            values[name] = value if name == "cores" else _number(name, value)
        return cls(**values)

    @property
    def text(self) -> str:
        """As on the command line; core points that came from memory by their number."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        if isinstance(self.cores, Cloud):
            values["cores"] = f"<{len(self.cores)} points>"
        return ",".join(f"{name}={value}" for name, value in values.items() if value is not None)

    @property
    def file(self) -> Path | None:
        """Where the core points are to be read from, if from a file."""
        return self.cores if isinstance(self.cores, Path) else None

    def absolute(self) -> M3C2Settings:
        """The same from any folder."""
        return self if self.file is None else replace(self, cores=self.file.absolute())

    def read(self) -> M3C2Settings:
        """The same with the core points themselves.

        Raises:
            InputError: their file cannot be read.
        """
        if self.file is None:
            return self
        from pcbench.io import read_cloud

        return replace(self, cores=read_cloud(self.file))


def compare_along_normals(
    reference: Reference, candidate: Index, registration: Registration, settings: M3C2Settings
) -> M3C2 | None:
    """M3C2 of an aligned candidate (minus the reference's origin), in the reference's coordinates.

    None where the reference has too few points for normals. Core points outside the region are left out, and those
    without a normal have no distance.

    Raises:
        InputError: no core point lies in the region.
    """
    if not reference.has_normals:
        return None
    radius = settings.radius
    if radius is None:
        radius = _CYLINDER_RADIUS * max(reference.spacing, Surface(candidate).spacing)
    if settings.cores is None:
        rows = np.flatnonzero(reference.inside)
        rows = rows[voxel_downsample_to(reference.points[rows], _MAX_CORES, start=radius / 2)]
        cores, normals = reference.points[rows], reference.surface.normals(rows)
    else:
        cores, normals = _given(reference, settings.cores)
    if settings.normal_radius is not None:
        normals = _fitted(reference, cores, settings.normal_radius)
    error = settings.registration_error
    if error is None:
        error = registration.rmse if registration.weakest_sigma is None else registration.weakest_sigma
    unknown = np.isnan(normals[:, 0])
    found = m3c2(
        reference.index,
        candidate,
        cores,
        np.where(unknown[:, None], [0.0, 0.0, 1.0], normals),
        radius=radius,
        half_length=_CYLINDER_REACH * radius if settings.depth is None else settings.depth,
        registration_error=error,
    )
    if unknown.any():
        distances, lod = (np.where(unknown, np.nan, values) for values in (found.distances, found.lod))
        found = found._replace(normals=normals, distances=distances, lod=lod)
    return found.shifted(-reference.origin)


def m3c2_warnings(found: M3C2) -> Iterator[Notice]:
    """Whether there is anything to compare: with cylinders that hold nothing, the map is empty."""
    if np.isfinite(found.significant).any():
        return
    measured = int(np.count_nonzero(np.isfinite(found.distances)))
    text = (
        f"M3C2 says nothing: a cylinder of radius {found.radius:.3g} and depth {found.half_length:.3g} holds points of"
        f" both clouds at {measured} of {len(found.cores)} core points, and five of each, which a level of detection"
        " needs, at none: --m3c2 radius=... and depth=... make it larger, and cores are in the reference's coordinates"
    )
    yield Notice("empty-m3c2", text)


def _given(reference: Reference, given: Cloud) -> tuple[FloatArray, FloatArray]:
    """Core points inside the region, minus the reference's origin, with their own normals or the reference's."""
    cores = given.points - reference.origin
    inside = np.ones(len(cores), bool) if reference.region is None else reference.region.contains(cores)
    if not inside.any():
        raise InputError(f"M3C2: none of the {len(cores)} core points lies inside the region: check --crop")
    cores = cores[inside]
    if given.normals is None:
        return cores, reference.surface.normals(reference.index.query(cores).indices)
    normals, known = unit(given.normals[inside])
    return cores, np.where(known[:, None], normals, np.nan)


def _fitted(reference: Reference, cores: FloatArray, radius: float) -> FloatArray:
    """Normals (K, 3) of planes through the reference's points within a radius of each core; NaN for less than three.

    Signs agree with the reference's normal at the nearest point.
    """
    signs = reference.surface.normals(reference.index.query(cores).indices)
    normals = np.full(cores.shape, np.nan)
    for row, core in enumerate(cores):
        near = reference.points[reference.index.query_radius(core[None], radius).indices]
        if len(near) < _MIN_PLANE:
            continue
        centred = near - near.mean(axis=0)
        normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
        normals[row] = normal if normal @ signs[row] >= 0 else -normal
    return normals


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"expected M3C2's {name} as a number, got {text!r}") from None
