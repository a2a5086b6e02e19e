"""All ladders by name, and the choice among them."""

from __future__ import annotations

from pcbench.studies.stress.ladders.changes import CHANGE_LADDERS
from pcbench.studies.stress.ladders.degenerate import DEGENERATE_LADDERS
from pcbench.studies.stress.ladders.ladder import Ladder, choose
from pcbench.studies.stress.ladders.noise import NOISE_LADDERS
from pcbench.studies.stress.ladders.parts import PART_LADDERS
from pcbench.studies.stress.ladders.photogrammetric import PHOTOGRAMMETRIC_LADDERS
from pcbench.studies.stress.ladders.start import START_LADDERS
from pcbench.studies.stress.ladders.warps import WARP_LADDERS

LADDERS = {
    ladder.name: ladder
    for ladder in (
        *START_LADDERS,
        *NOISE_LADDERS,
        *PHOTOGRAMMETRIC_LADDERS,
        *PART_LADDERS,
        *WARP_LADDERS,
        *CHANGE_LADDERS,
        *DEGENERATE_LADDERS,
    )
}


def selected(only: str | None, *, quick: bool) -> tuple[Ladder, ...]:
    """Return the ladders of a plan whose name, kind or subject contains a text; all of them without one.

    Raises:
        InputError: no ladder matches.
    """
    return choose(
        LADDERS.values(),
        only,
        quick=quick,
        texts_of=lambda ladder: (ladder.name, ladder.kind, *(subject.name for subject in ladder.subjects)),
        searched="name, kind or subject",
    )
