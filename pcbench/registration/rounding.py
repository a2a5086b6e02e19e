"""Warnings about coordinates that are stored in coarse steps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pcbench.errors import Notice
from pcbench.geometry.cloud import Cloud

COARSE_STEP = "coarse-step"
"""Code of the warning that rounded coordinates contribute to the distances."""
_MAX_SHARE = 0.1  # of the spacing that a step, and of the noise that the rounding error, may be without notice
# Noise below this share of the spacing is rather the surface between the points, unless most of it is rounding.
_MIN_NOISE_SHARE, _MOST = 0.03, 0.5


def step_warnings(
    reference: Cloud, candidate: Cloud, *, scale: float, spacing: float, noise: float, extent: float, unit: str | None
) -> Iterator[Notice]:
    """Yield warnings about clouds whose steps exceed a tenth of the spacing, or whose rounding a tenth of the noise.

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
        moved = factor * float(np.sqrt(np.trace(lattice.covariance)))
        limit = min(_MAX_SHARE * max(noise, _MIN_NOISE_SHARE * spacing), _MOST * noise)
        exceeded = []
        if step > _MAX_SHARE * spacing > 0:
            exceeded.append(f"the point spacing ({spacing:.3g}{unit_text})")
        if moved > limit > 0:
            exceeded.append(f"the registration's residuals ({noise:.3g}{unit_text})")
        if lattice.is_negligible(extent / factor) or not exceeded:
            continue
        steps = ", ".join(f"{value:.3g}" for value in factor * lattice.steps)
        text = (
            f"in steps of {steps}{unit_text}: rounding moves points by {moved:.3g}{unit_text} RMS, which is not small"
            f" against {' and '.join(exceeded)}, and which no registration removes; export again as float64, with a"
            " finer scale or more decimals, or subtract a constant from the coordinates before they become float32"
        )
        owners.setdefault(text, []).append(name)
    for text, names in owners.items():
        yield Notice(COARSE_STEP, f"x, y and z of the {' and the '.join(names)} are stored {text}")
