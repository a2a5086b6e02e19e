"""Fields of Gaussian splats, under the names of Kerbl et al. 2023, from the values that compact formats store.

All formats of splats give the same attributes, so that they are filtered, described and converted in the same way:
`f_dc_0` to `f_dc_2`, `f_rest_*`, `opacity` (logits), `scale_0` to `scale_2` (logarithms) and `rot_0` to `rot_3` (w, x,
y, z), as float32. The colours are those of the spherical harmonics of degree 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.splats import SplatModel, splat_model
from pcbench.io.files import Fields
from pcbench.io.names import Columns

SH_DC = 0.28209479177387814
"""The spherical harmonic of degree 0."""

DC = ("f_dc_0", "f_dc_1", "f_dc_2")
"""Names of the coefficients of degree 0 of red, green and blue."""

ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
"""Names of the quaternion of the axes, w first."""

_LEAST_OPACITY = 0.25 / 255  # a quarter of a step of 8 bits from 0 and 1, whose logits are infinite


def splat_fields(
    points: NDArray[Any],
    dc: NDArray[Any],
    opacities: NDArray[Any],
    log_scales: NDArray[Any],
    quaternions: NDArray[Any],
    rest: NDArray[Any] | None = None,
) -> Fields:
    """Return the fields of a cloud of splats.

    Args:
        points: (N, 3) means.
        dc: (N, 3) coefficients of degree 0 of red, green and blue.
        opacities: (N,) opacities from 0 to 1; 0 and 1 are moved inwards by a quarter of a step of 8 bits.
        log_scales: (N, 3) logarithms of the standard deviations along the axes.
        quaternions: (N, 4) rotations of the axes, w first.
        rest: (N, 3, K) other coefficients of red, green and blue.
    """
    columns: dict[str, NDArray[Any]] = dict(zip(DC, dc.T, strict=True))
    if rest is not None:
        flat = rest.reshape(len(rest), -1)
        columns |= {f"f_rest_{k}": flat[:, k] for k in range(flat.shape[1])}
    columns["opacity"] = logits(opacities)
    columns |= {f"scale_{k}": log_scales[:, k] for k in range(3)}
    columns |= {f"rot_{k}": quaternions[:, k] for k in range(4)}
    attributes: Columns = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in columns.items()}
    return Fields(points=points.astype(np.float64), colors=colors_of(dc), attributes=attributes)


def logits(opacities: NDArray[Any]) -> FloatArray:
    """Return the logits of opacities, which are finite because 0 and 1 are moved inwards."""
    inside = np.clip(opacities.astype(np.float64), _LEAST_OPACITY, 1 - _LEAST_OPACITY)
    values: FloatArray = np.log(inside / (1 - inside))
    return values


def dc_of(colors: NDArray[Any]) -> FloatArray:
    """Return the coefficients of degree 0 of 8-bit colours (N, 3)."""
    values: FloatArray = (colors / 255 - 0.5) / SH_DC
    return values


def colors_of(dc: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the 8-bit colours (N, 3) of coefficients of degree 0; NaN is black."""
    values = 255 * np.nan_to_num(0.5 + SH_DC * dc.astype(np.float64)).clip(0, 1)
    colors: NDArray[np.uint8] = np.rint(values).astype(np.uint8)
    return colors


def unit_quaternions(quaternions: NDArray[Any]) -> FloatArray:
    """Return quaternions (N, 4) of length 1; zero becomes no rotation, w = 1."""
    values = quaternions.astype(np.float64)
    lengths = np.linalg.norm(values, axis=1, keepdims=True)
    return np.where(lengths > 0, values / np.where(lengths > 0, lengths, 1), [1.0, 0.0, 0.0, 0.0])


def model_to_write(cloud: Cloud) -> SplatModel:
    """Return the splats of a cloud, which a format of splats stores.

    Raises:
        InputError: the cloud has no splats, or no rotations of their axes.
    """
    model = splat_model(cloud)
    if model is None or not cloud.attributes.keys() >= set(ROTATION):
        moved = " (a transform drops axes and rotations)" if "opacity" in cloud.attributes else ""
        raise InputError(
            "expected Gaussian splats with opacity, scale_0 to scale_2 and rot_0 to rot_3, got a cloud without these"
            f"{moved}: write it as .ply"
        )
    return model


def shift_advice(points: FloatArray) -> str:
    """Return what to do with splats at points (N, 3) that are too far from the origin for a format."""
    offset = ",".join(str(-round(x)) for x in np.median(points, axis=0))
    return f"shift them with `pcbench convert IN OUT --shift {offset}`, or write them as .ply"


def stack_columns(cloud: Cloud, names: Sequence[str]) -> FloatArray:
    """Return attributes of a cloud as columns (N, K)."""
    return np.stack([cloud.attributes[name].astype(np.float64) for name in names], axis=1)


def rotations_of(cloud: Cloud) -> FloatArray:
    """Return the unit quaternions (N, 4) of a cloud of splats, w first; values that are not finite become 0."""
    return unit_quaternions(np.nan_to_num(stack_columns(cloud, ROTATION), posinf=0, neginf=0))


def dc_coefficients(cloud: Cloud) -> FloatArray:
    """Return the coefficients of degree 0 (N, 3) of a cloud of splats, or those of its colours; grey without both."""
    if cloud.attributes.keys() >= set(DC):
        return stack_columns(cloud, DC)
    return np.zeros((len(cloud), 3)) if cloud.colors is None else dc_of(cloud.colors)


def to_bytes(values: FloatArray) -> NDArray[np.uint8]:
    """Round to whole numbers from 0 to 255; halves go up, and NaN is 0."""
    return np.floor(np.nan_to_num(values) + 0.5).clip(0, 255).astype(np.uint8)
