"""The verdict on the deformation of one cloud as lines of text, as `pcbench deform` prints it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pcbench.deformation import Deformation
from pcbench.measure.wording import with_unit
from pcbench.report.budget import changes_sentence


def deformation_lines(
    deformation: Deformation, name: str, unit: str | None, folder: Path | None = None
) -> Iterator[str]:
    """Yield the verdict, the changes, the score of each model, the noise, and the folder of the report.

    Args:
        deformation: the verdict.
        name: name of the candidate.
        unit: unit of lengths, if known.
        folder: the folder of the report, if there is one.
    """
    yield deformation.sentence(name, unit or "", is_noise=not deformation.changes)
    if deformation.changes:
        yield changes_sentence(deformation.changes, unit)
    for score in deformation.rungs:
        mark = "*" if score.model == deformation.model else " "
        residual = score.cv_score**0.5
        error = score.cv_se / (2 * residual or 1.0)
        yield f" {mark} {score.model:10} cross-validated residual {with_unit(f'{residual:.4g} ± {error:.2g}', unit)}"
    if noise := deformation.noise:
        white, correlated, correlation_length = (
            with_unit(f"{value:.3g}", unit)
            for value in (noise.sigma_white, noise.sigma_correlated, noise.correlation_length)
        )
        yield (
            f"noise: white {white}, correlated {correlated} (correlation length {correlation_length});"
            f" {deformation.pairs:,} pairs, effectively {noise.n_eff:,.0f} independent ones"
        )
    if folder is not None:
        yield f"report: {folder}"
