"""From sums over tiles to the answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation.field import FDR, Field, Measured
from pcbench.deformation.model import FACTORS, TILE, Geometry, Scores, estimate_noise
from pcbench.deformation.polynomials import PARAMETERS
from pcbench.deformation.size import amplitude, effective_count, minimum_detectable_rms, observable
from pcbench.deformation.sums import TileSums
from pcbench.deformation.verdict import bootstrap_signs, climb, decide
from pcbench.geometry.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Deformation:
    """The answer: `values` as the README describes them (`deformation` in comparison.json), and the field."""

    values: dict[str, Any]
    field: Field | None

    @classmethod
    def unanswered(cls, reason: str) -> Deformation:
        """Undecided, for want of anything to decide on."""
        nothing = dict.fromkeys(("parameters", "p_value", "p_value_noise", "amplitude", "remaining_rms", "noise"))
        rest = dict.fromkeys(("tiles", "pairs", "growth", "observable", "local", "minimum_detectable_rms"))
        values = {"verdict": "undecided", "model": "rigid", **nothing, "rungs": [], **rest, "warnings": [reason]}
        return cls(values, None)

    def shifted(self, origin: FloatArray) -> Deformation:
        """The same in coordinates that still carry `origin` (3,)."""
        return (
            self if self.field is None else replace(self, field=replace(self.field, places=self.field.places + origin))
        )

    def with_warnings(self, notes: Sequence[str]) -> Deformation:
        return replace(self, values={**self.values, "warnings": [*self.values["warnings"], *notes]})

    @property
    def changed(self) -> NDArray[np.bool_]:
        """(C,) which cells changed by themselves."""
        return np.zeros(0, dtype=bool) if self.field is None else self.field.changed

    @property
    def changed_share(self) -> float:
        return float(np.mean(self.changed)) if len(self.changed) else 0.0

    def with_changes(self, earlier: Deformation) -> Deformation:
        """This answer, which left out cells that an earlier one found changed, with these in its field and counts."""
        if self.field is None or earlier.field is None:
            return self
        left_out = earlier.field.changed
        parts = {
            name: np.concatenate([getattr(self.field, name), getattr(earlier.field, name)[left_out]])
            for name in Field.__annotations__
        }
        return Deformation({**self.values, "local": earlier.values["local"]}, Field(**parts))

    @property
    def verdict(self) -> str:
        return str(self.values["verdict"])

    @property
    def model(self) -> str:
        return str(self.values["model"])


def judge(sums: TileSums, *, metric: bool = True, resolution: float = 0.0, seed: int = 0) -> Deformation:
    """The verdict on a pair of clouds.

    Args:
        sums: over their pairs.
        metric: whether both clouds' scale is known; otherwise a scale is no deformation.
        resolution: a bend that is surely smaller is none: tangent planes through points that lie apart do not show it.
        seed: of the bootstrap and of the folds.
    """
    geometry = Geometry(sums)
    scores = Scores(geometry, sums.scores, sums.energy, sums.dyadic)
    noise = estimate_noise(geometry, scores)
    finding = decide(geometry, scores, noise, bootstrap_signs(geometry, seed), metric=metric, resolution=resolution)
    rungs = climb(geometry, scores, noise, seed)
    beyond = geometry.step("affine", finding.model if PARAMETERS[finding.model] > 12 else "quadratic")
    measured = Measured(geometry, scores, noise, sums)
    changed, tested, local = measured.changes(sums, resolution)
    remaining = sums.energy.sum() - geometry.explained(scores, finding.model)
    tiles = geometry.tiles[TILE]
    values = {
        "verdict": finding.verdict,
        "model": finding.model,
        "parameters": PARAMETERS[finding.model],
        "p_value": finding.evidence.p_tiles[TILE],
        "p_value_noise": finding.evidence.p_noise,
        "rungs": rungs,
        "amplitude": amplitude(geometry, scores, noise, beyond),
        "remaining_rms": math.sqrt(max(0.0, float(remaining)) / geometry.total),
        "noise": {
            "sigma_white": math.sqrt(noise.white),
            "sigma_correlated": math.sqrt(noise.correlated),
            "correlation_length": noise.correlation_length,
            "n_eff": effective_count(geometry, noise),
        },
        "tiles": {
            "count": int(tiles.max()) + 1,
            "side": FACTORS[TILE] * sums.side,
            "agreement": finding.agreement,
        },
        "pairs": int(sums.counts.sum()),
        "growth": {
            "with_distance": measured.growth(measured.distance),
            "with_height": measured.growth(measured.height),
        },
        "observable": observable(sums, tiles),
        "local": {"tiles_tested": int(tested.sum()), "tiles_changed": int(changed.sum()), "fdr": FDR},
        "minimum_detectable_rms": minimum_detectable_rms(geometry, noise),
        "warnings": list(finding.warnings),
    }
    field = Field(
        places=geometry.means,
        displacements=measured.displacements(finding.model),
        vertical=measured.vertical,
        sigma=measured.sigma,
        local=local,
        changed=changed,
        counts=sums.counts,
    )
    return Deformation(_rounded(values), field)


def _rounded(value: Any) -> Any:
    """Six digits: what a statistic is worth, and the same at any number of threads of the linear algebra."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
