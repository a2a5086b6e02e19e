"""Read and write .splat files of Gaussian splats: rows of 32 bytes without a header, as antimatter15's viewer has them.

A row has the mean and the standard deviations as float32, colour and opacity as bytes, and a quaternion as bytes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.splats import is_splat_attribute
from pcbench.io.files import Fields, Warn
from pcbench.io.names import left_out_warning
from pcbench.io.splat_fields import (
    SH_DC,
    dc_coefficients,
    dc_of,
    model_to_write,
    rotations_of,
    shift_advice,
    splat_fields,
    to_bytes,
    unit_quaternions,
)
from pcbench.scratch import atomic_write

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


def write_splat(path: Path, cloud: Cloud, warn: Warn) -> None:
    """Write a cloud of splats, and warn of what is lost.

    The splats are in descending order of their volume times their opacity, as antimatter15's converter sorts them:
    viewers that draw a file while it loads show the most important ones first.

    Raises:
        InputError: the cloud has no splats, or is too far from the origin for their size.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    model = model_to_write(cloud)
    with np.errstate(over="ignore"):
        largest = np.float32(np.abs(cloud.points).max())
    step, axis = float(np.spacing(largest)), float(np.median(model.largest_axes))
    if step > axis or not np.isfinite(largest):
        raise InputError(
            f"expected splats near the origin, got coordinates up to {np.abs(cloud.points).max():.3g}, which float32"
            f" rounds to {step:.2g}, more than half of the splats measure ({axis:.2g}): {shift_advice(cloud.points)}"
        )
    others = {"the normals": cloud.normals, "the crs": cloud.crs, "the unit": cloud.unit}
    others |= {name: values for name, values in cloud.attributes.items() if not is_splat_attribute(name)}
    if model.sh_degree != 0:
        others["harmonics above degree 0"] = cloud.points
    if line := left_out_warning("SPLAT", others):
        warn(line)
    warn("values are rounded: coordinates and axes to float32, colours, opacities and rotations to 8 bits")
    rows = np.zeros(len(cloud), _ROW)
    axes = np.nan_to_num(model.axes, posinf=0)
    rows["mean"] = cloud.points
    rows["scales"][:, : model.dimensions] = axes  # discs have a thickness of 0
    rows["color"][:, :3] = to_bytes(255 * (0.5 + SH_DC * dc_coefficients(cloud)))
    rows["color"][:, 3] = to_bytes(255 * model.opacities)
    rows["quaternion"] = to_bytes(128 * rotations_of(cloud) + 128)
    order = np.argsort(-axes.prod(axis=1) * np.nan_to_num(model.opacities), kind="stable")
    with atomic_write(path) as file:
        file.write(rows[order].tobytes())
