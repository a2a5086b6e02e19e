"""Gaussian splats as points: their means, what is said of them, and which of them count.

A model is a cloud whose attributes are those of the PLY files of Kerbl et al., "3D Gaussian Splatting for Real-Time
Radiance Field Rendering", 2023: the logits of opacities, and the logarithms of the standard deviations along two or
three axes. Huang et al., "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", 2024, have two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud

_NEEDED = ("opacity", "scale_0", "scale_1", "rot_0")
_DEGREES = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(5)}  # by the number of f_rest_*


@dataclass(frozen=True, eq=False)
class SplatModel:
    """What the splats of a cloud are.

    Attributes:
        dimensions: of a splat: 3, or 2 where it is a disc.
        sh_degree: of the spherical harmonics of its colour; None where the coefficients are of no degree.
        opacities: (N,) 0 to 1.
        axes: (N, 2 or 3) standard deviations along each axis, in the cloud's unit.
    """

    dimensions: int
    sh_degree: int | None
    opacities: FloatArray
    axes: FloatArray

    @property
    def largest_axes(self) -> FloatArray:
        """(N,) of each splat."""
        longest: FloatArray = self.axes.max(axis=1)
        return longest


def splat_model(cloud: Cloud) -> SplatModel | None:
    """What the splats of a cloud are; None where it has no attributes of splats.

    Opacities that all lie between 0 and 1 are taken as they are, others for logits, which trained models hold.
    """
    attributes = cloud.attributes
    if not attributes.keys() >= set(_NEEDED):
        return None
    stored = attributes["opacity"].astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):  # what is NaN or Inf in a file counts as nothing
        plain = bool(((stored >= 0) & (stored <= 1)).all())
        opacities = stored if plain else 1 / (1 + np.exp(-stored))
        names = [name for name in ("scale_0", "scale_1", "scale_2") if name in attributes]
        axes = np.exp(np.stack([attributes[name].astype(np.float64) for name in names], axis=1))
    rest = sum(name.startswith("f_rest_") for name in attributes)
    return SplatModel(len(names), _DEGREES.get(rest), opacities, axes)


def is_of_splats(name: str) -> bool:
    """Whether an attribute of a model is one that every model has."""
    return name == "opacity" or name.startswith(("scale_", "rot_", "f_dc_", "f_rest_"))


def check_limits(min_opacity: float | None, max_axis: float | None) -> None:
    """Raise InputError where limits, as `filter_splats` takes them, are no numbers that can be."""
    if min_opacity is not None and not (_is_number(min_opacity) and 0 <= min_opacity <= 1):
        raise InputError(f"expected the least opacity as a number 0 to 1, got {min_opacity!r}")
    if max_axis is not None and not (_is_number(max_axis) and 0 < max_axis < np.inf):
        raise InputError(f"expected the largest axis as a positive length, got {max_axis!r}")


def filter_splats(cloud: Cloud, min_opacity: float | None, max_axis: float | None) -> Cloud:
    """The means of those splats that are opaque and small enough: what a renderer hardly shows is no surface.

    Args:
        min_opacity: 0 to 1; None for any.
        max_axis: the largest standard deviation along an axis, in the cloud's unit; None for any.

    Raises:
        InputError: the cloud is no model of splats, a limit cannot be, or no splat is left.
    """
    check_limits(min_opacity, max_axis)
    if min_opacity is None and max_axis is None:
        return cloud
    model = splat_model(cloud)
    if model is None:
        raise InputError(
            "a least opacity and a largest axis are known of Gaussian splats only: the cloud has no attributes"
            f" {', '.join(_NEEDED)}"
        )
    keep = np.ones(len(cloud), dtype=np.bool_)
    if min_opacity is not None:
        keep &= model.opacities >= min_opacity
    if max_axis is not None:
        keep &= model.largest_axes <= max_axis
    if not keep.any():
        raise InputError(
            f"none of {len(cloud)} splats is left: opacities are {spread(model.opacities)}, largest axes"
            f" {spread(model.largest_axes)}"
        )
    return cloud if keep.all() else cloud.select(keep)


def spread(values: FloatArray) -> str:
    """Least, greatest and median, for messages."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return "unknown"
    return f"{finite.min():.3g} to {finite.max():.3g}, median {np.median(finite):.3g}"


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
