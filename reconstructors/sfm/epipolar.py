"""Agreement of cameras with the verified matches of their images, by epipolar distances; no 3D points are needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera

_MAX_DISTANCE_PX = 4.0  # distance of a match from its epipolar line: COLMAP's limit for verified matches
# With true cameras nearly all verified matches agree; with cameras of other images a few agree by chance.
_MIN_AGREEING_SHARE = 0.2
# Matches of a strong pair. That many are not verified by chance: they lie on one object, or on two that look alike.
MIN_STRONG_MATCHES = 100
_MAX_CONTRADICTING_PAIRS = 2  # strong pairs; sound solutions have none
_MAX_NAMES_SHOWN = 4  # images, and pairs per image, named in a note


class VerifiedPair(NamedTuple):
    """Two images, the number of their verified matches, and the share of matches that agree with the cameras."""

    a: str
    b: str
    matches: int
    share: float

    @property
    def agrees(self) -> bool:
        """Return whether at least half of the matches agree."""
        return self.share >= 0.5


@dataclass(frozen=True)
class Agreement:
    """Agreement of the verified image pairs with the cameras of their images."""

    pairs: tuple[VerifiedPair, ...]

    @property
    def share(self) -> float:
        """Share of all matches that agree. Pairs of few matches have little weight here, even if they are wrong."""
        total = sum(pair.matches for pair in self.pairs)
        return sum(pair.matches * pair.share for pair in self.pairs) / total if total else 0.0

    @property
    def share_of_pairs(self) -> float:
        """Share of the pairs in which at least half of the matches agree."""
        return sum(pair.agrees for pair in self.pairs) / len(self.pairs) if self.pairs else 0.0

    @property
    def strong_pairs(self) -> list[VerifiedPair]:
        """Pairs of at least 100 matches."""
        return [pair for pair in self.pairs if pair.matches >= MIN_STRONG_MATCHES]

    @property
    def contradicting_pairs(self) -> list[VerifiedPair]:
        """Strong pairs of which most matches contradict the cameras."""
        return [pair for pair in self.strong_pairs if not pair.agrees]

    @property
    def is_sound(self) -> bool:
        """Return whether hardly any strong pair contradicts the cameras.

        If several do, places that look alike were confused, by the pairs or by the cameras. Matches do not show which.
        """
        return len(self.contradicting_pairs) <= _MAX_CONTRADICTING_PAIRS

    def describe(self, cameras: str) -> str:
        """Return one line on the shares of matches and pairs; `cameras` names the kind of cameras."""
        matches = f"{self.share:.0%} of the verified matches agree with the {cameras} cameras"
        return f"{matches}, and {self.share_of_pairs:.0%} of the {len(self.pairs)} pairs"

    def describe_graph(self) -> str:
        """Describe the contradicting pairs by image, and the groups of images connected by the other strong pairs."""
        contradicting_pairs = self.contradicting_pairs
        by_image: dict[str, list[str]] = {}
        for pair in sorted(contradicting_pairs, key=lambda pair: -pair.matches):
            by_image.setdefault(pair.a, []).append(f"{pair.b} ({pair.matches})")
        named = [f"{a} with {_abbreviate(others)}" for a, others in by_image.items()]
        groups = _connected_components([pair for pair in self.strong_pairs if pair.agrees])
        sizes = ", ".join(f"{len(group)} ({group[0]} to {group[-1]})" for group in groups[:_MAX_NAMES_SHOWN])
        return f"{_abbreviate(named, '; ')}; the other strong pairs connect {sizes or 'none'} of the images"


def _abbreviate(names: Sequence[str], separator: str = ", ") -> str:
    """Join the first names, with "..." if there are more."""
    return separator.join(names[:_MAX_NAMES_SHOWN]) + (f"{separator}..." if len(names) > _MAX_NAMES_SHOWN else "")


def _connected_components(pairs: Sequence[VerifiedPair]) -> list[list[str]]:
    """Return the connected components of a graph of pairs, the largest first, each sorted by name."""
    groups: list[set[str]] = []
    for pair in pairs:
        merged = {pair.a, pair.b}.union(*(group for group in groups if pair.a in group or pair.b in group))
        groups = [group for group in groups if not group & merged] + [merged]
    return sorted((sorted(group) for group in groups), key=lambda group: (-len(group), group))


def check_cameras(database_file: Path, cameras: Mapping[str, Camera]) -> Agreement:
    """Return the agreement of a database's verified matches with the cameras given by a scene.

    Args:
        database_file: COLMAP database.
        cameras: Given cameras by image name.

    Raises:
        ReconstructionError: So few matches agree that the cameras must belong to other images.
    """
    agreement = epipolar_agreement(database_file, cameras)
    if agreement.share < _MIN_AGREEING_SHARE:
        raise ReconstructionError(
            f"the given cameras do not fit the images: {agreement.share:.1%} of the verified matches agree with them;"
            " check them (pcbench scene SCENE --figure cameras.png), or solve for cameras (--set poses=solve)"
        )
    return agreement


def epipolar_agreement(database_file: Path, cameras: Mapping[str, Camera]) -> Agreement:
    """Compute the share of verified matches within 4 pixels of their epipolar lines, per pair of images with cameras.

    Counting the matches that have a triangulated point would be less reliable: COLMAP drops tracks of two images and
    nearly parallel rays, even if their matches are right.

    Args:
        database_file: COLMAP database.
        cameras: Cameras by image name.
    """
    import pycolmap

    database = pycolmap.Database.open(database_file)
    names = {int(image.image_id): str(image.name) for image in database.read_all_images()}
    rays = {
        number: _ray_directions(cameras[name], np.asarray(database.read_keypoints(number), np.float64)[:, :2])
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
            distances = _epipolar_distances(
                rays[a][matches[:, 0]], rays[b][matches[:, 1]], cameras[names[a]], cameras[names[b]]
            )
            pairs.append(VerifiedPair(names[a], names[b], len(matches), float(np.mean(distances <= _MAX_DISTANCE_PX))))
    return Agreement(tuple(pairs))


def ambiguity_warning(agreement: Agreement, cameras: str) -> list[str]:
    """Return a warning if several strong pairs contradict the cameras (`cameras` names their kind), with the graph."""
    if agreement.is_sound:
        return []
    return [
        f"warning: {len(agreement.contradicting_pairs)} of {len(agreement.strong_pairs)} pairs of at least"
        f" {MIN_STRONG_MATCHES} matches contradict the {cameras} cameras: places that look alike were confused, by"
        f" these pairs or by the cameras, which may be far off: {agreement.describe_graph()} (all pairs: pairs.csv in"
        " the workspace)"
    ]


def write_pairs(path: Path, agreement: Agreement) -> None:
    """Write all pairs as CSV: the two images, the number of verified matches, and the share that agrees."""
    lines = [f'"{pair.a}","{pair.b}",{pair.matches},{pair.share:.3f}\n' for pair in agreement.pairs]
    path.write_text("image_a,image_b,matches,share_that_agrees\n" + "".join(lines), encoding="utf-8")


def _ray_directions(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Return ray directions (N, 3) of depth 1.

    A solved lens model may fold the image over. Its distortion is then ignored, and its matches will hardly agree.
    """
    try:
        return camera.intrinsics.directions(pixels)
    except InputError:
        k = camera.intrinsics
        return np.column_stack([(pixels - [k.cx, k.cy]) / [k.fx, k.fy], np.ones(len(pixels))])


def _epipolar_distances(a: FloatArray, b: FloatArray, camera_a: Camera, camera_b: Camera) -> FloatArray:
    """Return distances (N,) in pixels of rays b (N, 3), of depth 1 in camera b, from the epipolar lines of a."""
    rotated_rays = a @ (camera_b.cam_from_world.rotation @ camera_a.cam_from_world.rotation.T).T
    baseline = camera_b.cam_from_world.apply(camera_a.position[None])[0]
    planes = np.cross(baseline, rotated_rays)
    lengths = np.hypot(planes[:, 0], planes[:, 1])
    line_values = np.abs(np.einsum("ni,ni->n", planes, b))
    # Cameras at the same position have no epipolar lines.
    distances: FloatArray = camera_b.intrinsics.fx * np.divide(
        line_values, lengths, out=np.full(len(a), np.inf), where=lengths > 0
    )
    return distances
