"""`Comparison`: a finished comparison that can be saved as a report and shown in notebooks."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pcbench.errors import InputError, one_line
from pcbench.geometry.cloud import Cloud
from pcbench.report import exports, plot
from pcbench.report.answer import answer
from pcbench.report.figures import WINDOW_SIZE, Figures
from pcbench.report.folder import report_folder, write_report
from pcbench.report.inputs import FinishedComparison
from pcbench.report.notes import metric_warnings
from pcbench.report.table import html

_MAX_SHOWN_CANDIDATES = 2  # whose numbers the text of a comparison has


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(FinishedComparison):
    """A finished comparison, with methods that write and show it."""

    def save(self, folder: str | Path, *, figures: bool | Figures = True) -> None:
        """Write a report: report.html, comparison.json, metrics.csv, table.md, deviation clouds, matrices and pictures.

        Args:
            folder: the folder, created if necessary. A report in it is replaced.
            figures: whether to draw pictures, or their appearance. If these or the page cannot be made, a warning says
                why, and everything else is written.

        Raises:
            InputError: the folder has other files, or an input of the comparison; or a candidate's name cannot be part
                of file names.
            OSError: the folder cannot be written.
        """
        with report_folder(Path(folder), keep=[] if self.inputs is None else self.inputs.paths()) as scratch:
            style = figures if isinstance(figures, Figures) else Figures()
            problems = [write_report(scratch, self, style)]
            problems += [plot.draw_if_possible(scratch, figures=style).problem] if figures else []
        for problem in filter(None, problems):
            warnings.warn(problem, stacklevel=2)

    def plot(
        self,
        name: str | None = None,
        scalar: str = "plane_distance",
        *,
        range: float | None = None,
        off_screen: bool | None = None,
        window_size: tuple[int, int] = WINDOW_SIZE,
        background: str = "dark",
        lighting: bool = True,
    ) -> Any:
        """Return a plotter of one candidate, with the frame and the colour ranges of the report's pictures.

        Args:
            name: name of the candidate; None: the only one.
            scalar: a scalar of its deviation map, coloured, with the reference as a ghost; `m3c2_distance`;
                `completeness`: the reference, coloured by its distance to the candidate; or `deformation`: arrows.
            range: distance at which the colour range ends; default: as in the pictures. Not for `deformation`.
            off_screen: as in `pcbench.plot.cloud`.
            window_size: as in `pcbench.plot.cloud`.
            background: as in `pcbench.plot.cloud`.
            lighting: as in `pcbench.plot.cloud`.

        Returns:
            A `pyvista.Plotter` that is not yet shown: `.show()` opens a window, `.screenshot(file)` writes a picture.

        Raises:
            KeyError: no candidate has that name.
            InputError: the candidate has no such map or no displacements, an option is invalid, or there are several
                candidates and none is named.
            MissingExtra: pyvista is not installed.
            NoFiguresError: there is neither a display nor EGL nor OSMesa.
        """
        from pcbench.report.plot import maps
        from pcbench.report.plotters.candidates import CandidateMaps
        from pcbench.report.plotters.displacements import Displacements
        from pcbench.report.plotters.stage import Stage, Window

        if name is None:
            if len(self) > 1:
                raise InputError(f"expected the name of a candidate: {', '.join(c.name for c in self)}")
            name = self.candidates[0].name
        candidate, window = self[name], Window(off_screen, window_size, background, lighting)
        if scalar == "deformation":
            field = candidate.deformation.field
            if not candidate.deformation.is_tested:
                raise InputError(f"{name} was not tested for deformation, so there are no displacements")
            if field is None or not field.displacements.any():
                raise InputError(f"{name}: no deformation was found, so there are no displacements")
            points = candidate.deviation.points
            shared = maps.frame(None, {name: Cloud(points)}, self.cameras)
            stage = Stage(shared, self.reference.unit, window)
            Displacements.of(name, points, field.places, field.displacements).show(stage)
            return stage.plotter
        measured = CandidateMaps.of_comparison(self, Figures(range=range).range)
        stage = measured.stage(name, scalar, window)
        measured.show(stage, name, scalar)
        return stage.plotter

    def to_dataframe(self) -> Any:
        """Return all metrics as a `pandas.DataFrame` with the columns of metrics.csv, one number per row.

        Raises:
            MissingExtra: pandas is not installed.
        """
        return exports.data_frame(self)

    def __repr__(self) -> str:
        """Return the first sentence of the answer, each candidate or the names of more than two, and failed metrics."""
        sentence = answer(self)[0].partition(". ")[0].removesuffix(".")
        names = f"{len(self)} candidates: {', '.join(c.name for c in self)}"
        rest = [c.summary for c in self] if len(self) <= _MAX_SHOWN_CANDIDATES else [names]
        failures = [f"warning: {one_line(text)}" for text in metric_warnings(self)]
        return "\n  ".join([f"Comparison: {sentence}.", *rest, *failures])

    def _repr_html_(self) -> str:
        """Return the table for a notebook."""
        return html(self)
