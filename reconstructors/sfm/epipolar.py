"""Do cameras fit the matches of their images? By epipolar lines: no point needs to be known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera

_MAX_DISTANCE_PX = 4.0  # of a match from its epipolar line: COLMAP's for verified matches
# With true cameras nearly all verified matches agree; with those of other images a few do by chance.
_MIN_AGREEING = 0.2
STRONG = 100  # matches of a pair, which chance does not verify: they were found on one thing, or on two that look alike
_MAX_CONTRADICTING = 2  # strong pairs; sound solutions have none
_SHOWN = 4  # images, and pairs of each, that a note names


class Pair(NamedTuple):
    """Two images, the number of their verified matches, and the share of these that agree with the cameras."""

    a: str
    b: str
    matches: int
    share: float

    @property
    def agrees(self) -> bool:
        return self.share >= 0.5


@dataclass(frozen=True)
class Agreement:
    """How the verified pairs of images that have cameras agree with these."""

    pairs: tuple[Pair, ...]

    @property
    def share(self) -> float:
        """Of all their matches. Pairs of few matches count for little here, wrong as they may be."""
        total = sum(pair.matches for pair in self.pairs)
        return sum(pair.matches * pair.share for pair in self.pairs) / total if total else 0.0

    @property
    def share_of_pairs(self) -> float:
        """Of the pairs, those of which half of the matches or more agree."""
        return sum(pair.agrees for pair in self.pairs) / len(self.pairs) if self.pairs else 0.0

    @property
    def strong(self) -> list[Pair]:
        """The pairs of at least 100 matches."""
        return [pair for pair in self.pairs if pair.matches >= STRONG]

    @property
    def contradicting(self) -> list[Pair]:
        """The strong pairs of which most matches contradict the cameras."""
        return [pair for pair in self.strong if not pair.agrees]

    @property
    def is_sound(self) -> bool:
        """Whether hardly a strong pair contradicts the cameras. Where several do, places that look alike were taken
        for one, by the pairs or by the cameras; which of both, matches do not say.
        """
        return len(self.contradicting) <= _MAX_CONTRADICTING

    def describe(self, cameras: str) -> str:
        """One line on the shares of matches and pairs; `cameras` says which ones."""
        matches = f"{self.share:.0%} of the verified matches agree with the {cameras} cameras"
        return f"{matches}, and {self.share_of_pairs:.0%} of the {len(self.pairs)} pairs"

    def graph(self) -> str:
        """The contradicting pairs by image, and the groups of images that the other strong pairs tie together."""
        bad = self.contradicting
        by_image: dict[str, list[str]] = {}
        for pair in sorted(bad, key=lambda pair: -pair.matches):
            by_image.setdefault(pair.a, []).append(f"{pair.b} ({pair.matches})")
        named = [f"{a} with {_some(others)}" for a, others in by_image.items()]
        groups = _groups([pair for pair in self.strong if pair.agrees])
        sizes = ", ".join(f"{len(group)} ({group[0]} to {group[-1]})" for group in groups[:_SHOWN])
        return f"{_some(named, '; ')}; the strong pairs that agree tie together {sizes or 'none'} of the images"


def _some(names: Sequence[str], between: str = ", ") -> str:
    return between.join(names[:_SHOWN]) + (f"{between}..." if len(names) > _SHOWN else "")


def _groups(pairs: Sequence[Pair]) -> list[list[str]]:
    """The connected components of a graph of pairs, the largest first, each sorted by name."""
    groups: list[set[str]] = []
    for pair in pairs:
        joined = {pair.a, pair.b}.union(*(group for group in groups if pair.a in group or pair.b in group))
        groups = [group for group in groups if not group & joined] + [joined]
    return sorted((sorted(group) for group in groups), key=lambda group: (-len(group), group))


def check_cameras(database_file: Path, cameras: Mapping[str, Camera]) -> Agreement:
    """How a database's verified matches agree with the cameras that a scene gives.

    Raises:
        ReconstructionError: so few agree that the cameras are those of other images.
    """
    found = agreement(database_file, cameras)
    if found.share < _MIN_AGREEING:
        raise ReconstructionError(
            f"the given cameras do not fit the images: {found.share:.1%} of the verified matches agree with them;"
            " check them (pcbench scene SCENE --figure cameras.png), or solve them (--set poses=solve)"
        )
    return found


def agreement(database_file: Path, cameras: Mapping[str, Camera]) -> Agreement:
    """The pairs of a database whose images both have a camera, and the share of each pair's verified matches whose rays
    pass each other within 4 pixels of the second image.

    Counting the matches that triangulated points explain would say less: COLMAP leaves out tracks of two images and
    rays that are nearly parallel, right as their matches may be.
    """
    import pycolmap

    database = pycolmap.Database.open(database_file)
    names = {int(image.image_id): str(image.name) for image in database.read_all_images()}
    rays = {
        number: _rays(cameras[name], np.asarray(database.read_keypoints(number), np.float64)[:, :2])
        for number, name in names.items()
        if name in cameras and database.num_keypoints_for_image(number)
    }
    numbers, geometries = database.read_two_view_geometries()
    database.close()
    pairs = []
    for number, geometry in zip(numbers, geometries, strict=True):
        a, b = (int(image) for image in pycolmap.pair_id_to_image_pair(number))
        matches = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        if len(matches) and a in rays and b in rays:
            distances = _off_lines(rays[a][matches[:, 0]], rays[b][matches[:, 1]], cameras[names[a]], cameras[names[b]])
            pairs.append(Pair(names[a], names[b], len(matches), float(np.mean(distances <= _MAX_DISTANCE_PX))))
    return Agreement(tuple(pairs))


def repeated(found: Agreement, cameras: str) -> list[str]:
    """A warning where several strong pairs contradict the cameras (`cameras` says which), with the graph of pairs."""
    if found.is_sound:
        return []
    return [
        f"warning: {len(found.contradicting)} of {len(found.strong)} pairs of at least {STRONG} matches contradict the"
        f" {cameras} cameras: places that look alike were taken for one, by these pairs or by the cameras, which may be"
        f" far off: {found.graph()} (all pairs: pairs.csv in the workspace)"
    ]


def write_pairs(path: Path, found: Agreement) -> None:
    """All pairs as CSV: the two images, their verified matches, and the share that agrees."""
    lines = [f'"{pair.a}","{pair.b}",{pair.matches},{pair.share:.3f}\n' for pair in found.pairs]
    path.write_text("image_a,image_b,matches,share_that_agrees\n" + "".join(lines), encoding="utf-8")


def _rays(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Directions (N, 3) of depth 1. A lens that was solved for may fold the image over: then as if it had no
    distortion, with which its matches will hardly agree.
    """
    try:
        return camera.intrinsics.directions(pixels)
    except InputError:
        k = camera.intrinsics
        return np.column_stack([(pixels - [k.cx, k.cy]) / [k.fx, k.fy], np.ones(len(pixels))])


def _off_lines(a: FloatArray, b: FloatArray, camera_a: Camera, camera_b: Camera) -> FloatArray:
    """Pixels (N,) between rays b (N, 3) of depth 1 in the second camera and the epipolar lines of rays a (N, 3)."""
    turned = a @ (camera_b.cam_from_world.rotation @ camera_a.cam_from_world.rotation.T).T
    baseline = camera_b.cam_from_world.apply(camera_a.position[None])[0]
    planes = np.cross(baseline, turned)
    lengths = np.hypot(planes[:, 0], planes[:, 1])
    off = np.abs(np.einsum("ni,ni->n", planes, b))
    # Cameras at one place have no lines.
    distances: FloatArray = camera_b.intrinsics.fx * np.divide(
        off, lengths, out=np.full(len(a), np.inf), where=lengths > 0
    )
    return distances
