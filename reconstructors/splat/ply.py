"""Models of Gaussians as PLY files in the layout of Kerbl et al. 2023, which splat viewers open.

All properties are floats: x y z, nx ny nz (zero), f_dc_0..2, f_rest_* (all of red, then of green, then of blue),
opacity (logits), scale_0..2 (logarithms of standard deviations), rot_0..3 (wxyz). Coordinates and sizes are the
world's. Viewers expect rows of floats and draw in float32. If float32 has too few digits for the world's coordinates,
they are written relative to a local origin near the scene; a comment line gives the origin, and pcbench adds it on
reading. Another comment gives the color behind the Gaussians. Models of Huang et al. 2024 (2DGS) have no scale_2: their
discs become very flat Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.splats import splat_model
from pcbench.geometry.voxels import robust_bounds
from pcbench.io import read_cloud
from pcbench.io.files import Warn
from pcbench.io.names import XYZ
from pcbench.io.ply import ABOUT, write_vertices
from reconstructors.splat.model import Gaussians, LocalFrame

# Distance of the scene from the origin, in extents of the scene: farther away float32 has less than five digits for it.
_MAX_ORIGIN_DISTANCE = 200.0
_DISC_FLATNESS = 1e-4  # thickness of a disc, relative to its shorter axis
_MAX_SH_DEGREE = 3


def write_model(
    path: Path, gaussians: Gaussians, frame: LocalFrame, *, background: Sequence[float] | None = None
) -> None:
    """Write Gaussians of a local frame as a PLY file in the world.

    Args:
        path: the file.
        gaussians: the model.
        frame: its frame.
        background: red, green and blue from 0 to 1 behind the Gaussians, written as a comment.

    Raises:
        OSError: the file cannot be written; an existing one is then unchanged.
    """
    means, quats, log_scales, logits, sh = (
        part.detach().cpu().numpy()
        for part in (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logits, gaussians.sh)
    )
    world = frame.to_world(means)
    origin = local_origin(world)
    scales = log_scales.astype(np.float64) + np.log(frame.unit)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), 3 * (sh.shape[1] - 1))
    columns = dict(zip(XYZ, (world - origin).T, strict=True))
    columns |= dict.fromkeys(("nx", "ny", "nz"), np.zeros(len(world)))
    for name, values in (("f_dc", sh[:, 0]), ("f_rest", rest), ("opacity", logits), ("scale", scales), ("rot", quats)):
        numbered = {f"{name}_{k}": column for k, column in enumerate(values.T)} if values.ndim == 2 else {name: values}
        columns |= numbered
    about = {ABOUT: " ".join(f"{x:.0f}" for x in origin)} if origin.any() else {}
    if background is not None:
        about["background"] = " ".join(f"{channel:.4f}" for channel in background)
    write_vertices(path, {name: column.astype(np.float32) for name, column in columns.items()}, about)


def read_model(path: Path, on_warning: Warn | None = None) -> tuple[Gaussians, LocalFrame]:
    """Read the Gaussians of a PLY file and their frame.

    The frame has the world's unit and the world's origin or, far from it, a local origin near the scene. Splats with
    NaN or Inf are dropped with a warning.

    Args:
        path: the file.
        on_warning: called with each warning; `warnings.warn` if None.

    Raises:
        InputError: the file cannot be read or is not such a model; the message starts with the path.
    """
    import torch

    cloud = read_cloud(path, on_warning=on_warning)
    model = splat_model(cloud)
    missing = [
        name for name in (*_numbered_names("f_dc", 3), *_numbered_names("rot", 4)) if name not in cloud.attributes
    ]
    if model is None or missing:
        raise InputError(
            f"{path}: expected a model of Gaussian splats with opacity, scale_*, rot_* and f_dc_*, got attributes"
            f" {', '.join(cloud.attributes) or 'none'}"
        )
    if model.sh_degree is None or model.sh_degree > _MAX_SH_DEGREE:
        count = sum(name.startswith("f_rest_") for name in cloud.attributes)
        raise InputError(f"{path}: expected 0, 9, 24 or 45 properties f_rest_*, got {count}")

    def stack_columns(name: str, count: int) -> NDArray[np.float32]:
        columns = [cloud.attributes[column].astype(np.float32) for column in _numbered_names(name, count)]
        return np.stack(columns, axis=1) if count else np.empty((len(cloud), 0), np.float32)

    higher = (model.sh_degree + 1) ** 2 - 1
    rest = stack_columns("f_rest", 3 * higher).reshape(len(cloud), 3, higher).transpose(0, 2, 1)
    scales = stack_columns("scale", model.dimensions)
    if model.dimensions == 2:  # the normal of a disc is its third axis
        thin = scales.min(axis=1, keepdims=True) + np.float32(np.log(_DISC_FLATNESS))
        scales = np.concatenate([scales, thin], axis=1)
    origin = local_origin(cloud.points)
    parts = [
        (cloud.points - origin).astype(np.float32),
        stack_columns("rot", 4),
        scales,
        cloud.attributes["opacity"].astype(np.float32),
        np.concatenate([stack_columns("f_dc", 3)[:, None], rest], axis=1),
    ]
    finite = np.all([np.isfinite(part.reshape(len(cloud), -1)).all(axis=1) for part in parts], axis=0)
    if not finite.any():
        raise InputError(f"{path}: all {len(cloud)} splats have NaN or Inf")
    if not finite.all():
        _warn(f"{path}: dropped {np.count_nonzero(~finite)} of {len(cloud)} splats with NaN or Inf", on_warning)
        parts = [part[finite] for part in parts]
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(part)) for part in parts)), LocalFrame(origin, 1.0)


def _numbered_names(name: str, count: int) -> list[str]:
    return [f"{name}_{k}" for k in range(count)]


def local_origin(points: FloatArray) -> FloatArray:
    """Return the origin (3,) for float32 coordinates of points (N, 3): zeros, or a rounded point among them."""
    lower, upper = robust_bounds(points)
    middle = (lower + upper) / 2
    extent = float((upper - lower).max())
    far = extent > 0 and np.abs(middle).max() > _MAX_ORIGIN_DISTANCE * extent
    return middle.round() if far else np.zeros(3)


def _warn(text: str, on_warning: Warn | None) -> None:
    import warnings

    if on_warning is None:
        warnings.warn(text, stacklevel=3)
    else:
        on_warning(text)
