"""Read the scans of KITTI (.bin: rows of x, y, z, intensity) and nuScenes (.pcd.bin: x, y, z, intensity, ring).

The files are rows of little-endian float32 without a header: Geiger et al., "Vision meets Robotics: The KITTI Dataset",
2013; Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", 2020. Nothing in them tells how many
columns a row has, so the name and the size decide, and the values are checked.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.io.files import Fields, Warn
from pcbench.io.names import XYZ, Columns, take_points

_KITTI = (*XYZ, "intensity")
_NUSCENES = (*_KITTI, "ring")
_NUSCENES_NAME = ".pcd.bin"
_VALUE_BYTES = 4
_MAX_INTENSITY = 65535  # of 16 bits; KITTI has 0 to 1, nuScenes 0 to 255
_MAX_RANGE = 1e5  # metres; numbers of other binary files have all magnitudes
_OTHER_PROGRAMS = {
    b"CCB": "a project of CloudCompare: save its cloud as LAS, PLY or E57",
    b"glTF": "binary glTF: rename it to .glb",
    b"ply\n": "a PLY file: rename it to .ply",
    b"LASF": "a LAS file: rename it to .las",
}
_COLMAP = ("cameras.bin", "images.bin", "frames.bin", "rigs.bin", "project.bin")


def read_lidar_bin(path: Path, warn: Warn) -> Fields:
    """Read the points of one scan with their intensities and, for nuScenes, rings.

    Raises:
        InputError: the file is no such scan, or is truncated.
        OSError: the file cannot be read.
    """
    if path.name.lower() in _COLMAP:
        raise InputError(f"expected a scan, got a part of a COLMAP model: name its folder, {path.parent}")
    with path.open("rb") as file:
        start = file.read(8)
    if other := next((text for magic, text in _OTHER_PROGRAMS.items() if start.startswith(magic)), None):
        raise InputError(f"expected a scan of KITTI or nuScenes, got {other}")
    is_nuscenes = path.name.lower().endswith(_NUSCENES_NAME)
    names, data_set = (_NUSCENES, "nuScenes") if is_nuscenes else (_KITTI, "KITTI")
    size, row_bytes = path.stat().st_size, _VALUE_BYTES * len(names)
    if size % row_bytes:
        hint = ""
        if not is_nuscenes and size % (_VALUE_BYTES * len(_NUSCENES)) == 0:
            hint = f"; if rows are {', '.join(_NUSCENES)} as in nuScenes, name it {path.stem}{_NUSCENES_NAME}"
        raise InputError(
            f"expected rows of {len(names)} float32 ({', '.join(names)}) as in {data_set}, {row_bytes} bytes each, got"
            f" {size} bytes: copy the file again{hint}"
        )
    table = np.fromfile(path, np.dtype("<f4")).reshape(-1, len(names))
    columns: Columns = dict(zip(names, table.T, strict=True))
    intensity = columns["intensity"]
    with np.errstate(invalid="ignore"):  # signalling NaNs
        is_scan = ((intensity >= 0) & (intensity <= _MAX_INTENSITY)).all() and not (
            np.abs(table[:, :3]) > _MAX_RANGE
        ).any()
        if not is_scan:
            raise InputError(
                f"expected rows of {', '.join(names)} as float32, got other values: export the points as PLY or npy"
            )
        points = take_points(columns)
    return Fields(points=points, attributes={name: column.copy() for name, column in columns.items()}, unit="m")
