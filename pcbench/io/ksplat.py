"""Read .ksplat files of Gaussian splats, as mkkellogg's GaussianSplats3D (MIT) writes them, at levels 0 to 2.

A file has a header of 4096 bytes, a header of 1024 bytes for each section, and the sections. At levels 1 and 2, means
are whole numbers relative to the centres of buckets of neighbouring splats, and axes and rotations are halves.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.io.files import Fields, Warn
from pcbench.io.splat_fields import dc_of, splat_fields, unit_quaternions

_HEADER_BYTES, _SECTION_HEADER_BYTES = 4096, 1024
_HEADER = struct.Struct("<BBxxIIIIH")  # major, minor, sections at most, sections, splats at most, splats, level
_HARMONICS_OFFSET = 36  # least and largest coefficient at level 2, as float32
_SECTION = struct.Struct("<IIIIfHxxI4xIIH")
_MAX_DEGREE = 3
_BUCKET_BYTES = 12
_SCALE_RANGE = 32767  # of whole numbers, if a section states none
_HARMONICS_RANGE = 1.5  # of coefficients, if the header states none


class _Section(NamedTuple):
    """Header of a section; see `SplatBuffer.parseSectionHeaders` of the library."""

    splats: int
    capacity: int
    bucket_size: int
    buckets: int
    block_size: float
    bucket_bytes: int
    scale_range: int
    full_buckets: int
    partial_buckets: int
    degree: int

    @property
    def coefficients(self) -> int:
        """Number of coefficients of one colour, without degree 0."""
        return self.degree * (self.degree + 2)

    @property
    def bucket_storage(self) -> int:
        """Bytes before the splats: the sizes of partial buckets, and the centres of all."""
        return 4 * self.partial_buckets + self.bucket_bytes * self.buckets

    def row(self, level: int) -> np.dtype[np.void]:
        """Return the type of a splat."""
        mean, number, harmonic = [("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1")][level]
        return np.dtype(
            [
                ("mean", mean, 3),
                ("scales", number, 3),
                ("quaternion", number, 4),
                ("color", "u1", 4),
                ("harmonics", harmonic, 3 * self.coefficients),
            ]
        )


class _Values(NamedTuple):
    """Means, colours with opacity, axes, rotations and coefficients of the splats of a section."""

    means: FloatArray
    colors: NDArray[np.uint8]
    scales: FloatArray
    quaternions: FloatArray
    harmonics: FloatArray


def read_ksplat(path: Path, warn: Warn) -> Fields:
    """Read the splats of all sections.

    Raises:
        InputError: the file is damaged, truncated or of another version or level.
        OSError: the file cannot be read.
    """
    data = np.fromfile(path, np.uint8)
    if len(data) < _HEADER_BYTES:
        raise InputError(f"truncated: got {len(data)} of {_HEADER_BYTES} bytes of the header: copy the file again")
    major, minor, sections, _, _, splats, level = _HEADER.unpack(data[: _HEADER.size].tobytes())
    if major != 0 or minor < 1 or level > 2:
        raise InputError(
            f"expected a .ksplat file of version 0.1 with compression level 0 to 2, got version {major}.{minor} with"
            f" level {level}: export it again"
        )
    start = _HEADER_BYTES + sections * _SECTION_HEADER_BYTES
    if start > len(data):
        raise InputError(f"truncated: got {len(data)} bytes for {sections} sections: copy the file again")
    low, high = struct.unpack("<2f", data[_HARMONICS_OFFSET : _HARMONICS_OFFSET + 8].tobytes())
    coefficients = low or -_HARMONICS_RANGE, high or _HARMONICS_RANGE
    parts = []
    for number in range(sections):
        offset = _HEADER_BYTES + number * _SECTION_HEADER_BYTES
        section = _parse_section(data[offset : offset + _SECTION.size].tobytes(), number)
        end = start + section.bucket_storage + section.capacity * section.row(level).itemsize
        if end > len(data):
            raise InputError(
                f"truncated: section {number + 1} of {sections} ends at byte {end}, got {len(data)}: copy the file"
                " again"
            )
        if section.splats:
            with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers may be signalling NaNs
                parts.append(_read_section(data[start:end], section, level, coefficients))
        start = end
    if not parts:
        raise InputError("expected at least one splat, got 0: export the file again")
    if (count := sum(len(part.means) for part in parts)) != splats:
        warn(f"the header states {splats} splats, the sections have {count}: read {count}")
    if len(data) > start:
        warn(f"left out {len(data) - start} bytes after the last section")
    most = max(part.harmonics.shape[2] for part in parts)
    harmonics = [np.pad(part.harmonics, ((0, 0), (0, 0), (0, most - part.harmonics.shape[2]))) for part in parts]
    means, colors, scales, quaternions, _ = (np.concatenate(column) for column in zip(*parts, strict=True))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        log_scales, rotations = np.log(scales), unit_quaternions(quaternions)
        rest = np.concatenate(harmonics) if most else None
        return splat_fields(means, dc_of(colors[:, :3]), colors[:, 3] / 255, log_scales, rotations, rest)


def _parse_section(data: bytes, number: int) -> _Section:
    section = _Section(*_SECTION.unpack(data))
    if section.degree > _MAX_DEGREE or section.splats > section.capacity:
        raise InputError(
            f"section {number + 1}: expected harmonics of degree 0 to {_MAX_DEGREE} and at most {section.capacity}"
            f" splats, got {section.degree} and {section.splats}: export the file again"
        )
    return section._replace(scale_range=section.scale_range or _SCALE_RANGE)


def _read_section(data: NDArray[np.uint8], section: _Section, level: int, coefficients: tuple[float, float]) -> _Values:
    """Return the splats of a section from its bytes; `coefficients` are the least and largest at level 2."""
    dtype = section.row(level)
    rows = data[section.bucket_storage :][: section.splats * dtype.itemsize].view(dtype)
    means = rows["mean"].astype(np.float64)
    if level:
        centers = data[4 * section.partial_buckets : section.bucket_storage]
        step = section.block_size / 2 / section.scale_range
        means = (means - section.scale_range) * step + _bucket_centers(data, centers, section)
    harmonics = rows["harmonics"].astype(np.float64)
    if level == 2:
        low, high = coefficients
        harmonics = low + harmonics / 255 * (high - low)
    degrees, first = [], 0  # the coefficients of each degree are together: all of red, of green, of blue
    for degree in range(1, section.degree + 1):
        count = 2 * degree + 1
        degrees.append(harmonics[:, first : first + 3 * count].reshape(-1, 3, count))
        first += 3 * count
    return _Values(
        means,
        rows["color"],
        rows["scales"].astype(np.float64),
        rows["quaternion"].astype(np.float64),
        np.concatenate(degrees, axis=2) if degrees else np.empty((len(rows), 3, 0)),
    )


def _bucket_centers(data: NDArray[np.uint8], stored: NDArray[np.uint8], section: _Section) -> FloatArray:
    """Return the centre of the bucket of each splat (N, 3): full buckets come first, then partial ones of any size."""
    sizes = data[: 4 * section.partial_buckets].view("<u4").astype(np.int64)
    full = min(section.full_buckets * section.bucket_size, section.splats)
    # Sizes of a damaged file may be huge; no more splats than there are get a bucket.
    ends = np.minimum(np.cumsum(np.minimum(sizes, section.splats)) + full, section.splats)
    partial = np.searchsorted(ends, np.arange(full, section.splats), side="right") + section.full_buckets
    buckets = np.concatenate([np.arange(full) // max(section.bucket_size, 1), partial])
    are_stated = section.full_buckets + section.partial_buckets <= section.buckets
    if section.bucket_bytes != _BUCKET_BYTES or not are_stated or (len(buckets) and buckets.max() >= section.buckets):
        raise InputError(
            f"expected buckets of {_BUCKET_BYTES} bytes that hold {section.splats} splats, got {section.buckets} of"
            f" {section.bucket_bytes} bytes: export the file again"
        )
    centers: FloatArray = stored.view("<f4").reshape(-1, 3)[buckets].astype(np.float64)
    return centers
