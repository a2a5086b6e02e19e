"""Depth and normal maps, in memory and in COLMAP's file format.

A map's folder holds `depth.bin`, `normal.bin` and `confidence.bin`. Each file is WIDTH&HEIGHT&CHANNELS& in ASCII, then
float32 in little-endian order, channel by channel, each in row-major order (COLMAP's mvs/mat.h). COLMAP reads and
writes the first two; the third has the format of its depth maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, reason_of
from pcbench.scratch import atomic_write

DEPTH, NORMAL, CONFIDENCE = "depth.bin", "normal.bin", "confidence.bin"

_MAX_HEADER_BYTES = 64  # three integers


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths, normals and confidences of an image's pixels.

    Args:
        depth: (H, W) float32, z coordinates in the camera's frame; 0 without a depth.
        normal: (H, W, 3) float32, unit vectors in the camera's frame that face the camera; 0 without a depth.
        confidence: (H, W) float32, from 0 to 1.

    Raises:
        InputError: the shapes do not match.
    """

    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    confidence: NDArray[np.float32]

    def __post_init__(self) -> None:
        shape = self.depth.shape
        if len(shape) != 2 or self.normal.shape != (*shape, 3) or self.confidence.shape != shape:
            raise InputError(
                f"expected depths (H, W), normals (H, W, 3) and confidences (H, W), got {shape},"
                f" {self.normal.shape} and {self.confidence.shape}"
            )

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask (H, W) of the pixels with a depth."""
        return np.asarray(self.depth > 0)

    def where(self, mask: NDArray[np.bool_]) -> DepthMap:
        """Return the map with depths only inside a mask (H, W)."""
        zero = np.float32(0)
        return DepthMap(
            np.where(mask, self.depth, zero),
            np.where(mask[..., None], self.normal, zero),
            np.where(mask, self.confidence, zero),
        )


def write_map(folder: Path, depth_map: DepthMap) -> None:
    """Write the three files of a map into an existing folder.

    Raises:
        OSError: a file cannot be written.
    """
    write_raster(folder / DEPTH, depth_map.depth)
    write_raster(folder / NORMAL, depth_map.normal)
    write_raster(folder / CONFIDENCE, depth_map.confidence)


def read_map(folder: Path) -> DepthMap:
    """Read a map written by `write_map`, or by COLMAP under these names.

    Without a confidence file, confidence is 1 for all depths.

    Raises:
        InputError: a file is missing, damaged, or of another size; the message starts with the path.
    """
    depth, normal = read_raster(folder / DEPTH), read_raster(folder / NORMAL)
    has_confidence = (folder / CONFIDENCE).is_file()
    confidence = read_raster(folder / CONFIDENCE) if has_confidence else (depth > 0).astype(np.float32)
    try:
        return DepthMap(depth, normal, confidence)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None


def read_depth(folder: Path) -> NDArray[np.float32]:
    """Read only the depths (H, W) of a map.

    Raises:
        InputError: as `read_map`.
    """
    depth = read_raster(folder / DEPTH)
    if depth.ndim != 2:
        raise InputError(f"{folder / DEPTH}: expected one channel, got {depth.shape[2]}")
    return depth


def write_raster(path: Path, values: NDArray[np.float32]) -> None:
    """Write an array (H, W) or (H, W, C) in COLMAP's format.

    Raises:
        OSError: the file cannot be written.
    """
    height, width, channels = values.shape if values.ndim == 3 else (*values.shape, 1)
    planes = np.moveaxis(values, 2, 0) if values.ndim == 3 else values
    with atomic_write(path) as file:
        file.write(f"{width}&{height}&{channels}&".encode())
        file.write(np.ascontiguousarray(planes, dtype="<f4").data)


def read_raster(path: Path) -> NDArray[np.float32]:
    """Read an array (H, W), or (H, W, C) with several channels, in COLMAP's format.

    Raises:
        InputError: the file is missing or damaged; the message starts with the path.
    """
    try:
        with path.open("rb") as file:
            words = file.read(_MAX_HEADER_BYTES).split(b"&", 3)
            if len(words) < 4 or not all(word.isdigit() and len(word) < 10 for word in words[:3]):
                raise InputError(f"{path}: expected a COLMAP map, which starts with WIDTH&HEIGHT&CHANNELS&")
            width, height, channels = map(int, words[:3])
            start = sum(len(word) + 1 for word in words[:3])
            size = file.seek(0, 2) - start
            if not size or size != 4 * width * height * channels:
                raise InputError(
                    f"{path}: expected {4 * width * height * channels} bytes for {width} x {height} x {channels}"
                    f" values, got {size}: the file is truncated or not a map"
                )
            file.seek(start)
            values = np.fromfile(file, dtype="<f4").astype(np.float32, copy=False)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {reason_of(error)}") from error
    if channels == 1:
        return values.reshape(height, width)
    return np.ascontiguousarray(np.moveaxis(values.reshape(channels, height, width), 0, 2))
