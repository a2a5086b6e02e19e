"""Warnings about coordinates that are stored in coarse steps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pcbench.errors import Notice
from pcbench.geometry.cloud import Cloud

COARSE_STEP = "coarse-step"
"""Code of the warning that rounded coordinates contribute to the distances."""
_MAX_SHARE = 0.1  # of the point spacing or the noise, which a step does not affect noticeably


def step_warnings(
    reference: Cloud, candidate: Cloud, *, scale: float, spacing: float, noise: float, extent: float, unit: str | None
) -> Iterator[Notice]:
    """Yield warnings about clouds with coordinates in steps above a tenth of the spacing or the noise.

    Args:
        reference: the reference.
        candidate: the candidate, in its own coordinates.
        scale: factor from the candidate's lengths to the reference's.
        spacing: point spacing of the reference.
        noise: RMS residual of the registration.
        extent: extent of the reference.
        unit: unit of the reference, if known.
    """
    unit_text = f" {unit}" if unit else ""
    owners: dict[str, list[str]] = {}
    for name, cloud, factor in (("reference", reference, 1.0), ("candidate", candidate, scale)):
        lattice = cloud.quantisation
        step = factor * lattice.coarsest
        limits = (("the point spacing", spacing), ("the registration's residuals", noise))
        exceeded = [f"{words} ({length:.3g}{unit_text})" for words, length in limits if step > _MAX_SHARE * length > 0]
        if lattice.is_negligible(extent / factor) or not exceeded:
            continue
        steps = ", ".join(f"{value:.3g}" for value in factor * lattice.steps)
        moved = factor * float(np.sqrt(np.trace(lattice.covariance)))
        text = (
            f"in steps of {steps}{unit_text}, which exceeds a tenth of {' and of '.join(exceeded)}: rounding moves"
            f" points by {moved:.3g}{unit_text} RMS, which no registration removes; export again as float64, with a"
            " finer scale or more decimals, or subtract a constant from the coordinates before they become float32"
        )
        owners.setdefault(text, []).append(name)
    for text, names in owners.items():
        yield Notice(COARSE_STEP, f"x, y and z of the {' and the '.join(names)} are stored {text}")
