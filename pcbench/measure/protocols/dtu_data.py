"""The files of the DTU data set: observation masks, ground planes and reference clouds, as they are downloaded."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.io.matlab import read_matlab_arrays

_MARGIN_MM = 10  # of the published masks: the number at the end of their names
_SCANS = range(1, 129)
# Places in the folder of the archives (SampleSet.zip and Points.zip), or in one with the files alone.
_ROOTS = ("", "MVS Data", "SampleSet/MVS Data")
_MASK_FOLDERS = ("ObsMask", "")
_REFERENCE_FOLDERS = ("Points/stl", "stl", "")


@dataclass(frozen=True, eq=False)
class ObservationMask:
    """The part of space that the structured light observed, as voxels.

    Attributes:
        voxels: (X, Y, Z) whether each voxel was observed.
        box: (2, 3) lower and upper corner of the scan, in mm, as stored.
        side: side of the voxels in mm; the centre of the first one is the lower corner.
    """

    voxels: NDArray[np.bool_]
    box: FloatArray
    side: float

    def contains(self, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which cells (N, 3) are voxels that were observed."""
        observed = np.zeros(len(cells), dtype=np.bool_)
        inside = ((cells >= 0) & (cells < self.voxels.shape)).all(axis=1)
        observed[inside] = self.voxels[tuple(cells[inside].T)]
        return observed


def scan_number(*names: str) -> int:
    """Return the number of the scan from the first name that has one, such as scan24, 24, 007 or stl024_total.

    Raises:
        InputError: no name has exactly one number of a scan.
    """
    for name in names:
        for pattern in (r"(?:scan|stl)_?0*(\d+)", r"(?<!\d)(\d{3})(?!\d)", r"(\d+)"):
            numbers = {int(text) for text in re.findall(pattern, name, re.IGNORECASE)} & set(_SCANS)
            if len(numbers) == 1:
                return numbers.pop()
            if numbers:
                break
    given = " or ".join(repr(name) for name in names if name) or "no name"
    raise InputError(f"dtu: expected the number of a scan, 1 to {_SCANS[-1]}, in a name such as scan24, got {given}")


def mask_file(folders: Sequence[Path], scan: int) -> Path:
    """Return the path of ObsMask{scan}_10.mat.

    Raises:
        InputError: there is no such file.
    """
    return _data_file(folders, _MASK_FOLDERS, f"ObsMask{scan}_{_MARGIN_MM}.mat")


def read_mask(file: Path) -> ObservationMask:
    """Read an observation mask.

    Raises:
        InputError: the file is damaged.
    """
    voxels, box, side = read_matlab_arrays(file, "ObsMask", "BB", "Res")
    if voxels.ndim != 3 or box.shape != (2, 3) or side.size != 1:
        raise InputError(
            f"{file}: expected ObsMask with three axes, BB of 2 x 3 numbers and one number Res, got shapes"
            f" {voxels.shape}, {box.shape} and {side.shape}"
        )
    corners, length = box.astype(np.float64), float(side.reshape(-1)[0])
    if not (np.isfinite(corners).all() and (corners[1] > corners[0]).all() and 0 < length < np.inf):
        raise InputError(f"{file}: expected a box BB with an extent along each axis and Res above 0")
    return ObservationMask(voxels != 0, corners, length)


def plane_file(folders: Sequence[Path], scan: int) -> Path:
    """Return the path of Plane{scan}.mat.

    Raises:
        InputError: there is no such file.
    """
    return _data_file(folders, _MASK_FOLDERS, f"Plane{scan}.mat")


def read_plane(file: Path) -> FloatArray:
    """Read a ground plane (4,): points x above it have a positive product with (x, 1).

    Raises:
        InputError: the file is damaged.
    """
    [stored] = read_matlab_arrays(file, "P")
    plane = stored.astype(np.float64).reshape(-1)
    if plane.shape != (4,) or not np.isfinite(plane).all():
        raise InputError(f"{file}: expected P with four numbers, got {plane.shape}")
    return plane


def reference_file(folders: Sequence[Path], scan: int) -> Path:
    """Return the path of stl{scan}_total.ply.

    Raises:
        InputError: there is no such file.
    """
    return _data_file(folders, _REFERENCE_FOLDERS, f"stl{scan:03}_total.ply")


def _data_file(folders: Sequence[Path], places: Sequence[str], name: str) -> Path:
    for folder in folders:
        for root in _ROOTS:
            for place in places:
                if (file := folder / root / place / name).is_file():
                    return file
    searched = f" in {folders[0]}" if folders else ""
    raise InputError(
        f"dtu: found no {name}{searched}: name the folder of the data set, with ObsMask/ and Points/stl/, by"
        " --protocol-data"
    )
