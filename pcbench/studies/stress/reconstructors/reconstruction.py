"""Reconstructions: does a reconstructor keep half of its F-score on worse photographs, and does it say so if not?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pcbench.studies.stress.subject import DEGRADED, ENDS, REFUSED, RIGHT, WARNED, Group, Outcome, StressCell, Subject

UNPERTURBED = "unperturbed"

MIN_SCORE_SHARE = 0.5
"""Smallest F-score of a right reconstruction over that of the unperturbed run.

An F-score is halved when, for example, a complete cloud loses two thirds of the surface, or two thirds of its points
are wrong.
"""

WARNING_PREFIX = "warning: "
"""Start of a reconstructor's note that says that the result may be wrong; see `pcbench.plugins.Reconstruction`."""


@dataclass(frozen=True)
class ReconstructionCell(StressCell):
    """Result of one reconstruction; lengths are in metres.

    Attributes:
        fscore: F-score over the surface that three cameras of the unperturbed scene saw; None without a measured cloud.
        standard: F-score of the unperturbed run of the same method and seed; None if it has none.
        precision: share of the points within the threshold of the true surface.
        recall: share of that surface with a point within the threshold.
        threshold: the threshold.
        rms: root mean square distance from the points to the true surface.
        points: number of points; None without a cloud.
        cameras: number of images whose camera the reconstructor returned.
        images: number of images that it got.
        registration: how the cloud was registered to the truth: `none`, `cameras` or a method of `compare`.
        notes: notes of the reconstructor.
        wall_s: wall time of the reconstruction, in seconds; None if unknown.
    """

    fscore: float | None = None
    standard: float | None = None
    precision: float | None = None
    recall: float | None = None
    threshold: float | None = None
    rms: float | None = None
    points: int | None = None
    cameras: int | None = None
    images: int | None = None
    registration: str = ""
    notes: tuple[str, ...] = ()
    wall_s: float | None = None

    @property
    def warns(self) -> bool:
        """Return whether the reconstructor says that its result may be wrong."""
        return any(note.startswith(WARNING_PREFIX) for note in self.notes)

    @property
    def is_good(self) -> bool:
        """Return whether the F-score is at least half that of the unperturbed run."""
        return (
            self.fscore is not None
            and self.standard is not None
            and self.standard > 0
            and self.fscore >= MIN_SCORE_SHARE * self.standard
        )


def settle(cells: Sequence[ReconstructionCell]) -> list[ReconstructionCell]:
    """Return the cells with the outcomes of delivered clouds, which the unperturbed run of the method decides."""
    standards = {(cell.method, cell.seed): cell for cell in cells if cell.ladder == UNPERTURBED}
    return [_settled(cell, standards[cell.method, cell.seed]) for cell in cells]


def _settled(cell: ReconstructionCell, standard: ReconstructionCell) -> ReconstructionCell:
    cell = replace(cell, standard=standard.fscore)
    if cell.outcome == RIGHT and standard.outcome != RIGHT:
        text = f"not judged: the run on unperturbed photographs ended as {standard.outcome}"
        return replace(cell, outcome=standard.outcome, message=text)
    if cell.outcome != RIGHT or cell.is_good:
        return cell
    return replace(cell, outcome=WARNED if cell.warns else DEGRADED)


RECONSTRUCTION = Subject(
    name="reconstruction",
    title="Reconstructors",
    noun="reconstruction",
    key="reconstructions",
    cell=ReconstructionCell,
    outcomes=(
        Outcome(RIGHT, "at least half of the unperturbed F-score", Group.SUCCESS),
        Outcome(WARNED, "poor, with a warning", Group.SAID_SO),
        Outcome(REFUSED, "refused with an error", Group.SAID_SO),
        Outcome(DEGRADED, "poor, without a warning", Group.CONFIDENT),
        *ENDS,
    ),
    legend="right: at least half of the F-score of the unperturbed run; warned: less, with a warning; refused: an error"
    " instead of a cloud; degraded: less, without a warning; CPU s: median; MiB: largest peak of the process",
    success="half of the F-score kept [% of runs]",
    charts=("outcomes", "scores", "matrix", "severity"),
)
