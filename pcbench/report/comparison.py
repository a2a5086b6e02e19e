"""The comparison that users get: the measured one, with the files its clouds came from, that can be saved and shown."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike, NDArray

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.measure import comparison, results
from pcbench.measure.settings import Settings
from pcbench.report.figures import Figures
from pcbench.report.inputs import Inputs


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(results.Comparison):
    """A reference, its candidates, and the differences between them. `comparison["a"]` is the candidate named a.

    Attributes:
        inputs: the files that the clouds came from; None where they came from memory.
    """

    inputs: Inputs | None = None

    @classmethod
    def of(cls, measured: results.Comparison, inputs: Inputs | None = None) -> Comparison:
        return cls(measured.settings, measured.reference, measured.candidates, measured.differences, inputs)

    def save(self, folder: str | Path, *, figures: bool | Figures = True) -> None:
        """Write a report: comparison.json, metrics.csv, table.md, deviation clouds, matrices and pictures.

        Args:
            folder: is made; an older report in it is replaced, anything else in it is refused.
            figures: whether pictures are drawn, or how they look.

        Pictures that cannot be drawn are warned about: the numbers are delivered all the same.

        Raises:
            InputError: the folder holds something else, or an input of the comparison; or a candidate's name cannot be
                part of file names.
            OSError: the folder cannot be written.
        """
        from pcbench.report.folder import report_folder, write_report
        from pcbench.report.plot import draw_if_possible

        with report_folder(Path(folder), keep=[] if self.inputs is None else self.inputs.paths()) as scratch:
            look = figures if isinstance(figures, Figures) else Figures()
            write_report(scratch, self, look)
            problem = draw_if_possible(scratch, figures=look) if figures else None
        if problem is not None:
            warnings.warn(problem, stacklevel=2)

    def _repr_html_(self) -> str:
        """The table, for notebooks."""
        from pcbench.report.table import html

        return html(self)


def compare(
    reference: Cloud | Mesh | ArrayLike,
    candidates: Sequence[Cloud | ArrayLike] | Mapping[str, Cloud] | Mapping[str, ArrayLike] | Cloud | NDArray[Any],
    settings: Settings | None = None,
    *,
    on_step: Callable[[str], None] | None = None,
) -> Comparison:
    """Compare candidate clouds with a reference: register, measure both ways, map, and say whether they are bent.

    Args:
        reference: a cloud, an (N, 3) array, or a mesh, which is sampled by area with its faces' normals.
        candidates: one cloud, several, or several by name.
        settings: see `pcbench.Settings`.
        on_step: called with a few words before every step that takes time.

    Raises:
        InputError: a cloud, a setting or a region is not usable.
        RegistrationError: a candidate does not overlap the reference.
    """
    return Comparison.of(comparison.compare(reference, candidates, settings, on_step=on_step))
