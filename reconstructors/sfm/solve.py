"""Cameras that are solved for, and whether they can be believed: both mappers where that is cheap, and without pairs
that take one place for another where structure repeats.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.cameras import Camera
from pcbench.geometry.transform import robust_similarity
from pcbench.scenes import Scene
from reconstructors.sfm.epipolar import STRONG, Agreement, agreement, repeated
from reconstructors.sfm.features import DATABASE, some
from reconstructors.sfm.mapping import Mapper, largest_component, map_images
from reconstructors.sfm.matches import without_pairs
from reconstructors.sfm.model import Refine, cameras_of

_MAX_BOTH = 30  # images that are solved in both ways
# Of the pairs; where fewer agree, wrong ones may have moved a camera, and the strong pairs alone are asked.
_FEW_PAIRS = 0.9
# A camera's two places are apart by more than their errors where they are so many pixels of its view from each other,
# and so many times as far as the cameras' places are by the median.
_MAX_APART_PX, _MAX_APART_MEDIANS = 2.0, 5.0


@dataclass(frozen=True, eq=False)
class SolvedModel:
    """A model of the images, how all verified pairs agree with it, whichever it was solved from, and notes on what is
    left out.
    """

    how: str
    model: Any
    cameras: Mapping[str, Camera]
    agreement: Agreement
    notes: Sequence[str]

    @property
    def is_sound(self) -> bool:
        return self.agreement.is_sound

    def describe(self) -> str:
        bad, strong = len(self.agreement.contradicting), len(self.agreement.strong)
        return f"{self.how} registers {len(self.cameras)} images and is contradicted by {bad} of {strong} strong pairs"


def solve(verified: Path, scene: Scene, workspace: Path, mapper: Mapper, refine: Refine, seed: int) -> SolvedModel:
    """The cameras and points of the largest component.

    Few images are solved in both ways, and from strong pairs alone where many pairs are wrong; it is said where these
    differ. Where strong pairs contradict the cameras, images of any number are solved again without these pairs, and
    from strong pairs alone: most pairs that repeated structure makes are weak. What is kept says `better`.

    Raises:
        ReconstructionError: no two images start a model.
    """

    def solved(how: Mapper, matches: Path, words: str = "", name: str = "") -> SolvedModel:
        model, notes = largest_component(map_images(matches, scene, workspace, how, refine, seed, name), scene)
        cameras = cameras_of(model)
        return SolvedModel(f"{how} mapping{words}", model, cameras, agreement(verified / DATABASE, cameras), notes)

    asked = solved(mapper, verified)
    found = [asked]

    def also(how: Mapper, matches: Path, words: str = "", name: str = "") -> None:
        # This way nothing may be found, or COLMAP may give up: it is a second opinion.
        with suppress(ReconstructionError, RuntimeError, ValueError):
            found.append(solved(how, matches, words, name))

    is_cheap = len(scene) <= _MAX_BOTH
    if is_cheap:
        also("global" if mapper == "incremental" else "incremental", verified)
    best = better(found)
    if not best.is_sound:
        pairs = [(pair.a, pair.b) for pair in best.agreement.contradicting]
        consistent = without_pairs(verified, workspace, "consistent", dropped=pairs)
        also(mapper, consistent, f" without {len(pairs)} contradicting pairs", "consistent-solved")
    if not best.is_sound or (is_cheap and best.agreement.share_of_pairs < _FEW_PAIRS):
        strong = without_pairs(verified, workspace, "strong", least=STRONG)
        also("incremental", strong, f" from pairs of at least {STRONG} matches", "strong-solved")
    best = better(found)
    notes = [*best.notes]
    if best is not asked:
        notes.append(f"{asked.describe()}; kept: {best.describe()}")
    if best.is_sound:
        for other in found:
            if other is not best and (other.is_sound or best is asked):
                notes += differences(best, other)
    return replace(best, notes=[*notes, best.agreement.describe("solved"), *repeated(best.agreement, "solved")])


def better(found: Sequence[SolvedModel]) -> SolvedModel:
    """Of sound solutions the one with the most images, else the one that the fewest strong pairs contradict; the first
    of equals. One with few of the images is none: hardly a pair is left to contradict it.
    """
    most = max(len(solution.cameras) for solution in found)
    whole = [solution for solution in found if 2 * len(solution.cameras) >= most]
    if found[0].is_sound and found[0] in whole:
        return found[0]
    sound = [solution for solution in whole if solution.is_sound]
    if sound:
        return max(sound, key=lambda solution: len(solution.cameras))
    return min(whole, key=lambda solution: len(solution.agreement.contradicting))


def differences(kept: SolvedModel, other: SolvedModel) -> list[str]:
    """A note on the cameras that another solution puts elsewhere by more than the errors of both.

    A camera that little fixes, such as one that sees a single wall, is what the two ways find in different places. How
    far is compared with the pixels of its view and with the other cameras: shared errors move these alike.
    """
    names = [name for name in kept.cameras if name in other.cameras]
    positions = [np.array([cameras[n].position for n in names]) for cameras in (other.cameras, kept.cameras)]
    try:
        fit = robust_similarity(*positions)
    except InputError:  # fewer than three cameras, or all on one line
        return []
    apart = np.linalg.norm(fit.apply(positions[0]) - positions[1], axis=1)
    pixel = np.array([_pixel(kept, name) for name in names])
    median = float(np.median(apart))
    if median > _MAX_APART_PX * float(np.median(pixel)):
        far = f"the cameras {median:.3g} from here (median), {apart.max():.3g} at most"
    else:
        where = apart > np.maximum(_MAX_APART_PX * pixel, _MAX_APART_MEDIANS * median)
        if not where.any():
            return []
        order = [int(k) for k in np.argsort(-apart) if where[k]]
        named = some([f"{names[k]} {apart[k]:.3g}" for k in order])
        far = f"{named} from here, the others {median:.3g} (median): little fixes them"
    return [f"{other.describe()}, and puts {far}"]


def _pixel(solution: SolvedModel, name: str) -> float:
    """What a pixel of a camera is at the points that it sees (their median depth), in the units of the cameras."""
    model, camera = solution.model, solution.cameras[name]
    image = model.find_image_with_name(name)
    seen = [model.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
    if not seen:
        return 0.0
    return float(np.median(camera.cam_from_world.apply(np.array(seen))[:, 2])) / camera.intrinsics.fx
