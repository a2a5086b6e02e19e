"""Result types of the search for changes; the names and the order of the fields are those of the JSON in a report.

Lengths are in the reference's unit. A value that does not exist is None.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray

STABLE, UNMATCHED = -1, -2
"""Labels of points that belong to no change: on the other cloud's surface, or without a counterpart in it because it
does not cover the place or hides it."""

MOVED, ADDED, REMOVED = "moved", "added", "removed"
"""Kinds of changes: a part that both clouds show, apart from each other; a part of the candidate alone; a part of the
reference alone."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Change:
    """One connected part of the scene that changed.

    Attributes:
        kind: `MOVED`, `ADDED` or `REMOVED`.
        place: its centre, in the reference's coordinates.
        outline: corners of its convex outline in x and y, counter-clockwise, without repetition of the first one.
        area: area of its surface, in squared units.
        volume: volume between the surfaces of both clouds, in cubed units: positive where the candidate lies above the
            reference. None if one cloud shows no surface there.
        mean: mean signed distance of the candidate from the reference along the reference's normals, which point
            upwards, and on walls along the larger one of x and y. None as above.
        peak: signed distance that is largest in size (a thousandth of the points exceeds it). None as above.
        motion: mean displacement of the part from the reference to the candidate; None for added and removed parts.
        points_reference, points_candidate: number of points of each cloud that belong to it.
        p_value: probability that sampling and noise produce a change this significant anywhere in the scene.
    """

    kind: str
    place: Point
    outline: tuple[tuple[float, float], ...]
    area: float
    volume: float | None
    mean: float | None
    peak: float | None
    motion: Point | None
    points_reference: int
    points_candidate: int
    p_value: float

    @property
    def distance(self) -> float:
        """Length of the motion, or mean distance between the clouds."""
        sizes = [abs(self.mean or 0.0), *([] if self.motion is None else [float(np.linalg.norm(self.motion))])]
        return max(sizes)

    @property
    def importance(self) -> float:
        """Area times distance, by which changes are ordered."""
        return self.area * self.distance

    def shifted(self, origin: FloatArray) -> Change:
        """Return the same change in coordinates that include `origin` (3,)."""
        x, y, z = (float(here + there) for here, there in zip(self.place, origin, strict=True))
        outline = tuple((float(a + origin[0]), float(b + origin[1])) for a, b in self.outline)
        return replace(self, place=(x, y, z), outline=outline)


@dataclass(frozen=True, eq=False)
class Changes:
    """Changes between a reference and an aligned candidate, and the points that belong to each.

    Attributes:
        found: changes, the most important one first: by area times mean distance.
        of_reference: (N,) number of the change of each reference point, its place in `found`, or `STABLE`, `UNMATCHED`.
        of_candidate: (M,) the same for each point of the candidate.
        left_out: number of small places that look changed and were not searched, because there are too many.
    """

    found: tuple[Change, ...]
    of_reference: NDArray[np.int32]
    of_candidate: NDArray[np.int32]
    left_out: int = 0

    @property
    def warnings(self) -> tuple[Notice, ...]:
        """A warning if places were not searched."""
        if not self.left_out:
            return ()
        text = f"{self.left_out:,} more small places look changed and were not searched: compare parts of the scene"
        return (Notice("unsearched-places", f"{text} (pcbench crop) to search them"),)

    @property
    def share(self) -> float:
        """Share of the points of both clouds that belong to changes, 0 to 1: the larger one."""
        return max(
            float(np.mean(labels >= 0)) if len(labels) else 0.0 for labels in (self.of_reference, self.of_candidate)
        )

    def shifted(self, origin: FloatArray) -> Changes:
        """Return the same changes in coordinates that include `origin` (3,)."""
        return replace(self, found=tuple(change.shifted(origin) for change in self.found))

    @classmethod
    def none(cls, reference: int, candidate: int) -> Changes:
        """Return the result without changes, for clouds of these numbers of points."""
        return cls((), np.full(reference, STABLE, np.int32), np.full(candidate, STABLE, np.int32))
