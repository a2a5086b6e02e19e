"""Displacements of a candidate as exaggerated arrows over its pale cloud."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, as_rows
from pcbench.geometry.cloud import Cloud
from pcbench.report.colors import Range
from pcbench.report.plot.bends import displacement_vectors, round_exaggeration
from pcbench.report.plotters.stage import Stage
from pcbench.report.viewing import up_of


@dataclass(frozen=True, eq=False)
class Displacements:
    """Displacements that are finite and not zero.

    Attributes:
        name: name of the candidate, for the title; may be empty.
        cloud: (N, 3) points of the candidate.
        places: (M, 3) places.
        vectors: (M, 3) displacements there.
    """

    name: str
    cloud: FloatArray
    places: FloatArray
    vectors: FloatArray

    @classmethod
    def of(cls, name: str, cloud: FloatArray, places: ArrayLike, vectors: ArrayLike) -> Displacements:
        """Return the displacements that are finite and not zero.

        Raises:
            InputError: there are none, or not as many vectors as places.
        """
        tails, arrows = as_rows("places", places), as_rows("vectors", vectors)
        if tails.shape != arrows.shape:
            raise InputError(f"expected one vector for each of the {len(tails)} places, got {len(arrows)}")
        lengths = np.linalg.norm(arrows, axis=1)
        moved = np.isfinite(lengths) & (lengths > 0) & np.isfinite(tails).all(axis=1)
        if not moved.any():
            raise InputError("expected displacements, got none that is finite and not zero")
        return cls(name, cloud, tails[moved], arrows[moved])

    @classmethod
    def of_field(cls, name: str, cloud: FloatArray, field: Cloud | None) -> Displacements | None:
        """Return the displacements of a report's NAME_deformation.ply; None if its model has no displacements.

        Raises:
            KeyError: the file lacks an attribute.
        """
        if field is None:
            return None
        vectors = displacement_vectors(field)
        return cls.of(name, cloud, field.points, vectors) if np.nan_to_num(vectors).any() else None

    @cached_property
    def lengths(self) -> FloatArray:
        """Lengths (M,) of the displacements."""
        lengths: FloatArray = np.linalg.norm(self.vectors, axis=1)
        return lengths

    @cached_property
    def typical(self) -> float:
        """95th percentile of the lengths."""
        return float(np.percentile(self.lengths, 95))

    def default_exaggeration(self, stage: Stage) -> float:
        """Return a round factor that makes long arrows 3 to 7 % of the scene's diagonal."""
        return round_exaggeration(self.typical, stage.frame.box)

    def show(self, stage: Stage, exaggeration: float | None = None) -> float:
        """Show the arrows over the cloud, in place of earlier ones, and return their exaggeration."""
        factor = exaggeration or self.default_exaggeration(stage)
        stage.add_ghost(self.cloud)
        heights, scale = self.vectors @ up_of(stage.frame.cameras), Range(-self.typical, self.typical, signed=True)
        stage.add_bar(stage.add_arrows(self.places, factor * self.vectors, heights, scale), "vertical displacement")
        highest = f"95 % below {stage.with_unit(self.typical)}, largest {stage.with_unit(float(self.lengths.max()))}"
        name = f"{self.name}: " if self.name else ""
        stage.write_title(f"{name}displacements exaggerated {factor:.3g} times ({highest})")
        return factor
