"""Is a pose right? What moving away from it costs, held against what moving away costs the reference itself.

A wrong pose may fit well: flat ground lies on flat ground, and where points fill a volume something is always near. But
it fits little better than its surroundings do. So the candidate is displaced to both sides along every motion, and the
growth of its distances to the reference is compared with the growth for the reference's own points at the same places,
each searched among the others. For two samples of one surface or of one wood the two are alike, whatever the scene and
the density. At a wrong pose the first falls far behind, if not along all motions then along those that the pose is
wrong by: hence the least share of them is what counts.

A scanner samples lines. What is displaced by less than the lines lie apart meets its own line again or none, whether
the pose is right or not: so the displacement spans several gaps between lines, and the reference's own points stand for
those of another scan, which lie anywhere between its lines.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.normals import Surface

LEAST = 0.75  # below this share a pose is doubtful
SURE = 0.85  # above it a pose is right, however little of the candidate meets the reference

_MAX_PLACES = 600  # of the reference that are looked at: the share is then good to some per cent
_MIN_PLACES = 50  # for less the share is chance
_MIN_SPACINGS, _MAX_SPACINGS, _MAX_OF_EXTENT = 3.0, 12.0, 0.1  # that the candidate is displaced by
_GAPS = 5.0  # and at least so many times what lies between a scanner's lines, for most of the places
_SIGMAS = 8.0  # and at least so many times what the residuals are, where those are larger than the spacing
# Motions that the reference's own points feel by less tell nothing: of the displacement, and in standard errors.
_MIN_GROWTH, _MIN_SIGNIFICANCE = 0.03, 8.0
_FEW, _MANY, _MORE = 12, 512, 1.5  # points of a scanner's line that are looked through for the next line
_MIN_BREADTH = 0.1  # variance across over variance along, from which on points are no line


class Contrast(NamedTuple):
    """What a pose is better than its surroundings by."""

    share: float  # of the reference's own, the least of all motions that its own points feel
    felt: float  # by the reference's own points along the motion that they feel least, of the displacement


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
) -> Contrast | None:
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
        None where too few points meet.
    """
    near = np.random.default_rng(0).permutation(near)
    # One candidate point a place of the reference: what lies beyond the reference's end is nearest to its last points
    # only, and would otherwise count for as much as it is large.
    places, first = np.unique(nearest.indices[near], return_index=True)
    if len(places) < _MIN_PLACES or spacing <= 0:
        return None
    rows = near[first]
    some = slice(None, None, max(1, len(places) // _MAX_PLACES))
    own, ours, theirs = places[some], moved[rows[some]], surface.points[places[some]]
    across = _to_next_line(surface.index, theirs)
    gap = float(np.percentile(np.linalg.norm(across, axis=1), 75))
    distance = max(_MAX_SPACINGS * spacing, _GAPS * gap, _SIGMAS * sigma)
    distance = min(distance, max(_MAX_OF_EXTENT * extent, _MIN_SPACINGS * spacing))
    center = ours.mean(axis=0)
    radius = float(np.sqrt(np.square(ours - center).sum(axis=1).mean())) or 1.0
    size = 7 if with_scale else 6

    def grown(distances: FloatArray) -> FloatArray:
        """(size, P) growth of each point's distance to both sides; none counts for more than the displacement."""
        bounded = (np.minimum(distances, distance) / distance).reshape(1 + 2 * size, -1)
        growth: FloatArray = (bounded[1::2] + bounded[2::2]) / 2 - bounded[0]
        return growth

    def felt_by_reference(points: FloatArray) -> FloatArray:
        displaced = _displaced(points, center, distance, radius, size)
        found = surface.index.query(displaced, 2)
        is_own = found.indices[:, 0] == np.tile(own, 1 + 2 * size)  # what a point itself was does not count
        return grown(np.where(is_own, found.distances[:, 1], found.distances[:, 0]))

    felt = grown(surface.index.query(_displaced(ours, center, distance, radius, size)).distances).mean(axis=1)
    growth = felt_by_reference(theirs)
    mean, error = growth.mean(axis=1), growth.std(axis=1) / np.sqrt(len(own))
    telling = mean > np.maximum(_MIN_GROWTH, _MIN_SIGNIFICANCE * error)
    if not telling.any():
        return None
    share = float((felt[telling] / mean[telling]).min())
    if share < SURE:
        noise = _added_noise(moved[rows], surface.points[places])
        rng = np.random.default_rng(0)
        theirs = theirs + rng.normal(0, noise, theirs.shape) + rng.uniform(-0.5, 0.5, (len(theirs), 1)) * across
        blurred = np.minimum(mean, felt_by_reference(theirs).mean(axis=1))[telling]
        # Where the noise would leave nothing to feel, the plain share stands.
        share = float((felt[telling] / np.where(blurred > _MIN_GROWTH, blurred, mean[telling])).min())
    return Contrast(share, float(mean.min()))


def _added_noise(candidate: FloatArray, reference: FloatArray) -> float:
    """Standard deviation that the candidate (N, 3) has more than the reference at the same N places."""
    own, other = _roughness(candidate), _roughness(reference)
    return float(np.sqrt(max(0.0, own**2 - other**2)))


def _roughness(points: FloatArray) -> float:
    """Robust standard deviation of points about the tangent planes of the points nearest to them."""
    surface = Surface(Index(points))
    some = points[:: max(1, len(points) // _MAX_PLACES)]
    nearest = surface.index.query(some, 2).indices[:, 1]
    steps = np.einsum("ni,ni->n", some - points[nearest], surface.normals(nearest))
    return 1.4826 * float(np.median(np.abs(steps)))


def _to_next_line(index: Index, places: FloatArray) -> FloatArray:
    """What lies between the line that each of P places of an index is on and the next line, (P, 3) along the surface.

    More and more neighbours are looked at until they are no line; the widest step across is the gap. Where points are
    even, it is about their spacing; zero where no other line is found.
    """
    gaps, alone, count = np.zeros(places.shape), np.arange(len(places)), _FEW
    while len(alone) and count <= min(_MANY, len(index)):
        arms = index.points[index.query(places[alone], count).indices] - places[alone, None]
        variances, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", arms, arms, optimize=False) / count)
        broad = variances[:, 1] > _MIN_BREADTH * variances[:, 2]
        axis = axes[broad, :, 1]
        apart = np.sort(np.abs(np.einsum("pki,pi->pk", arms[broad], axis, optimize=False)), axis=1)
        gaps[alone[broad]] = np.diff(apart, axis=1).max(axis=1, initial=0.0)[:, None] * axis
        alone, count = alone[~broad], int(_MORE * count)
    return gaps


def _displaced(points: FloatArray, center: FloatArray, distance: float, radius: float, size: int) -> FloatArray:
    """Points (N, 3) as they are, moved by `distance` to either side along the axes, about them (at `radius`), by scale.

    Returns:
        (N + 2 size N, 3); the scale only where `size` is 7.
    """
    ways = [points]
    arms = points - center
    for shift in distance * np.eye(3):
        ways += [points + shift, points - shift]
    cos, sin = np.cos(distance / radius), np.sin(distance / radius)
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for s in (sin, -sin):
            turned = arms.copy()
            turned[:, b], turned[:, c] = cos * arms[:, b] - s * arms[:, c], s * arms[:, b] + cos * arms[:, c]
            ways.append(turned + center)
    if size == 7:
        factor = np.exp(distance / radius)
        ways += [center + factor * arms, center + arms / factor]
    return np.concatenate(ways)
