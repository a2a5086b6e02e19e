"""All ladders by name, and the choice among them."""

from __future__ import annotations

from pcbench.errors import InputError
from pcbench.studies.stress.ladders.degenerate import DEGENERATE_LADDERS
from pcbench.studies.stress.ladders.ladder import Ladder
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
        *DEGENERATE_LADDERS,
    )
}


def selected(only: str | None, *, quick: bool) -> tuple[Ladder, ...]:
    """Return the ladders of a plan whose name, kind or subject contains a text; all of them without one.

    Raises:
        InputError: no ladder matches.
    """
    planned = [ladder for ladder in LADDERS.values() if ladder.quick or not quick]
    if only is None:
        return tuple(planned)
    words = [word.strip() for word in only.split(",") if word.strip()]

    def matches(ladder: Ladder) -> bool:
        return any(word in text for word in words for text in (ladder.name, ladder.kind, *ladder.subjects))

    found = tuple(ladder for ladder in planned if matches(ladder))
    if not found:
        names = ", ".join(ladder.name for ladder in planned)
        if any(matches(ladder) for ladder in LADDERS.values()):
            raise InputError(f"--only {only} is not in the quick plan: leave out --quick, or choose from {names}")
        raise InputError(f"expected --only as part of a ladder's name, kind or subject, got {only!r}: {names}")
    return found
