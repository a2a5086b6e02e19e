"""Gaussian splats as point clouds: their attributes, and filters by opacity and size.

A model is a cloud with the attributes of the PLY files of Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance
Field Rendering", 2023: logits of opacities, and logarithms of the standard deviations along three axes. The splats of
Huang et al., "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", 2024, have two axes.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from pcbench.errors import InputError, Notice
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud

SPLAT_MEANS = "splat-means"
"""Code of the notice that a candidate is a model of Gaussian splats, measured at their means."""
_REQUIRED_ATTRIBUTES = ("opacity", "scale_0", "scale_1", "rot_0")
_SH_DEGREES = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(5)}  # keyed by the number of f_rest_* attributes


@dataclass(frozen=True, eq=False)
class SplatModel:
    """Properties of the splats of a cloud.

    Attributes:
        dimensions: 3, or 2 for flat discs.
        sh_degree: degree of the colours' spherical harmonics; None if the number of coefficients matches no degree.
        opacities: (N,) values from 0 to 1.
        axes: (N, 2 or 3) standard deviations along the axes, in the cloud's unit.
    """

    dimensions: int
    sh_degree: int | None
    opacities: FloatArray
    axes: FloatArray

    @property
    def largest_axes(self) -> FloatArray:
        """Largest standard deviation of each splat (N,), in the cloud's unit."""
        longest: FloatArray = self.axes.max(axis=1)
        return longest


def splat_model(cloud: Cloud) -> SplatModel | None:
    """Return the properties of a cloud's splats, or None if it lacks the attributes of splats.

    Opacities that all lie between 0 and 1 are used as they are; others are logits, as in trained models.
    """
    attributes = cloud.attributes
    if not has_splats(attributes):
        return None
    stored = attributes["opacity"].astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):  # files may contain NaN or Inf
        plain = bool(((stored >= 0) & (stored <= 1)).all())
        opacities = stored if plain else 1 / (1 + np.exp(-stored))
        names = [name for name in ("scale_0", "scale_1", "scale_2") if name in attributes]
        axes = np.exp(np.stack([attributes[name].astype(np.float64) for name in names], axis=1))
    rest = sum(name.startswith("f_rest_") for name in attributes)
    return SplatModel(len(names), _SH_DEGREES.get(rest), opacities, axes)


def means_notice(count: int) -> Notice:
    """Return the notice that a candidate is measured at the means of its `count` splats."""
    return Notice(
        SPLAT_MEANS,
        f"the candidate is a model of Gaussian splats: it is measured at the means of its {count:,} splats, which need"
        " not lie on the surface; --min-opacity and --max-axis leave out transparent and large ones",
    )


def has_splats(attributes: Collection[str]) -> bool:
    """Return whether a cloud with attributes of these names is a model of splats."""
    return set(_REQUIRED_ATTRIBUTES) <= set(attributes)


def is_splat_attribute(name: str) -> bool:
    """Return whether an attribute of this name belongs to the splat, as in the PLY files of Kerbl et al. 2023."""
    return name == "opacity" or name.startswith(("scale_", "rot_", "f_dc_", "f_rest_"))


def check_limits(min_opacity: float | None, max_axis: float | None) -> None:
    """Raise InputError if a limit of `filter_splats` is not a number in its range."""
    if min_opacity is not None and not (_is_number(min_opacity) and 0 <= min_opacity <= 1):
        raise InputError(f"expected a minimum opacity from 0 to 1, got {min_opacity!r}")
    if max_axis is not None and not (_is_number(max_axis) and 0 < max_axis < np.inf):
        raise InputError(f"expected a maximum axis as a positive length, got {max_axis!r}")


def filter_splats(cloud: Cloud, min_opacity: float | None, max_axis: float | None) -> Cloud:
    """Keep the splats that are opaque and small enough: transparent and very large splats are rarely on a surface.

    Args:
        cloud: a splat model.
        min_opacity: minimum opacity, from 0 to 1; None for no limit.
        max_axis: maximum standard deviation along any axis, in the cloud's unit; None for no limit.

    Raises:
        InputError: the cloud is not a splat model, a limit is out of range, or no splat is left.
    """
    check_limits(min_opacity, max_axis)
    if min_opacity is None and max_axis is None:
        return cloud
    model = splat_model(cloud)
    if model is None:
        raise InputError(
            "expected a Gaussian splat model to filter by opacity or axis, got a cloud without the attributes"
            f" {', '.join(_REQUIRED_ATTRIBUTES)}"
        )
    keep = np.ones(len(cloud), dtype=np.bool_)
    if min_opacity is not None:
        keep &= model.opacities >= min_opacity
    if max_axis is not None:
        keep &= model.largest_axes <= max_axis
    if not keep.any():
        raise InputError(
            f"expected limits that keep a splat, got none of {len(cloud)} left: opacities are"
            f" {spread(model.opacities)}, largest axes {spread(model.largest_axes)}"
        )
    return cloud if keep.all() else cloud.select(keep)


def spread(values: FloatArray) -> str:
    """Format the minimum, maximum and median of finite values for messages."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return "unknown"
    return f"{finite.min():.3g} to {finite.max():.3g}, median {np.median(finite):.3g}"


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
