"""Read .splat files of Gaussian splats: rows of 32 bytes without a header, as antimatter15's viewer defines them.

A row has the mean and the standard deviations as float32, colour and opacity as bytes, and a quaternion as bytes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.io.files import Fields, Warn
from pcbench.io.splat_fields import dc_of, splat_fields, unit_quaternions

_ROW = np.dtype([("mean", "<f4", 3), ("scales", "<f4", 3), ("color", "u1", 4), ("quaternion", "u1", 4)])
_OTHER_FORMATS = {b"ply": ".ply", b"\x1f\x8b": ".spz", b"NGSP": ".spz"}


def read_splat(path: Path, warn: Warn) -> Fields:
    """Read the splats: means, colours, opacities, axes and rotations.

    Raises:
        InputError: the file is not rows of 32 bytes, or its values are no splats.
        OSError: the file cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        start = file.read(4)
    if other := next((name for magic, name in _OTHER_FORMATS.items() if start.startswith(magic)), None):
        raise InputError(f"expected rows of a .splat file, got a {other} file: rename it")
    if size % _ROW.itemsize:
        raise InputError(
            f"truncated: expected rows of {_ROW.itemsize} bytes, got {size} bytes, which is {size // _ROW.itemsize}"
            f" splats and {size % _ROW.itemsize} bytes: copy or export the file again"
        )
    rows = np.fromfile(path, _ROW)
    scales, opacities = rows["scales"], rows["color"][:, 3] / 255
    if (negative := int(np.count_nonzero((scales < 0).any(axis=1)))) > 0:
        raise InputError(
            f"expected standard deviations of at least 0, got negative ones in {negative} of {len(rows)} splats: export"
            " the file again"
        )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        log_scales = np.log(scales.astype(np.float64))
        quaternions = unit_quaternions((rows["quaternion"].astype(np.float64) - 128) / 128)
        return splat_fields(rows["mean"], dc_of(rows["color"][:, :3]), opacities, log_scales, quaternions)
