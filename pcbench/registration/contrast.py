"""Is a pose right? What moving away from it costs, held against what moving away costs the reference itself.

A wrong pose may fit well: flat ground lies on flat ground, and where points fill a volume something is always near. But
it fits little better than its surroundings do. So the candidate is displaced to both sides along every motion, and the
growth of its distances to the reference is compared with the growth for the reference's own points at the same places,
each searched among the others. For two samples of one surface or of one wood the two are alike, whatever the scene and
the density. At a wrong pose the first falls far behind, if not along all motions then along those that the pose is
wrong by: hence the least share of them is what counts.
"""

from __future__ import annotations

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Matches
from pcbench.geometry.normals import Surface

_MAX_PLACES = 500  # of the reference that are looked at: the share is then good to some per cent
_MIN_PLACES = 50  # for less the share is chance
_MIN_SPACINGS, _MAX_SPACINGS, _MAX_OF_EXTENT = 3.0, 12.0, 0.1  # that the candidate is displaced by
_SIGMAS = 8.0  # and at least so many times what the residuals are, where those are larger than the spacing
_MIN_GROWTH = 0.3  # of the largest: motions that the reference's own points hardly feel tell nothing


def contrast(
    surface: Surface,
    moved: FloatArray,
    nearest: Matches,
    near: IntArray,
    *,
    sigma: float,
    spacing: float,
    extent: float,
    with_scale: bool,
) -> float | None:
    """The candidate's growth of distances by displacement as a share of the reference's own: about 1 at a right pose.

    Args:
        surface: the reference.
        moved: (M, 3) candidate points at the pose.
        nearest: the reference's points that are nearest to them.
        near: (K,) rows of those that may have a counterpart.
        sigma: robust standard deviation of the residuals of those that lie on the reference.
        spacing, extent: of the reference.
        with_scale: whether the scale is one of the motions.

    Returns:
        The least share of all motions that the reference's own points feel; None where too few points meet.
    """
    near = np.random.default_rng(0).permutation(near)
    # One candidate point a place of the reference: what lies beyond the reference's end is nearest to its last points
    # only, and would otherwise count for as much as it is large.
    places, first = np.unique(nearest.indices[near], return_index=True)
    if len(places) < _MIN_PLACES or spacing <= 0:
        return None
    step = max(1, len(places) // _MAX_PLACES)
    places, rows = places[::step], near[first[::step]]
    ours, theirs = moved[rows], surface.points[places]
    distance = max(_MAX_SPACINGS * spacing, _SIGMAS * sigma)
    distance = min(distance, max(_MAX_OF_EXTENT * extent, _MIN_SPACINGS * spacing))
    center = ours.mean(axis=0)
    radius = float(np.sqrt(np.square(ours - center).sum(axis=1).mean())) or 1.0

    def growth(points: FloatArray, own: IntArray | None) -> FloatArray:
        """(6 or 7,) mean growth of the distances, none of which counts for more than the displacement."""
        ways = _displaced(points, center, distance, radius)
        displaced = np.concatenate([points, *(ways if with_scale else ways[:-2])])
        if own is None:
            distances = surface.index.query(displaced).distances
        else:  # not what the point itself was
            found = surface.index.query(displaced, 2)
            is_own = found.indices[:, 0] == np.tile(own, len(displaced) // len(own))
            distances = np.where(is_own, found.distances[:, 1], found.distances[:, 0])
        means = np.minimum(distances, distance).reshape(-1, len(points)).mean(axis=1)
        grown: FloatArray = (means[1::2] + means[2::2]) / 2 - means[0]
        return grown

    felt, own_felt = growth(ours, None), growth(theirs, places)
    telling = own_felt > max(_MIN_GROWTH * own_felt.max(), 1e-3 * distance)
    return float((felt[telling] / own_felt[telling]).min()) if telling.any() else None


def _displaced(points: FloatArray, center: FloatArray, distance: float, radius: float) -> list[FloatArray]:
    """Points (N, 3) moved by `distance` to either side along the three axes, about them (at `radius`), and by scale."""
    moved = []
    arms = points - center
    cos, sin = np.cos(distance / radius), np.sin(distance / radius)
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = distance
        moved += [points + shift, points - shift]
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for s in (sin, -sin):
            turned = arms.copy()
            turned[:, b], turned[:, c] = cos * arms[:, b] - s * arms[:, c], s * arms[:, b] + cos * arms[:, c]
            moved.append(turned + center)
    growth = distance / radius
    return [*moved, center + (1 + growth) * arms, center + (1 - min(growth, 0.9)) * arms]
