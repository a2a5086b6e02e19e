"""Solves for cameras and checks whether they are reliable.

Few images are solved by both mappers. If structure repeats, cameras are solved again without pairs that confuse places.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.cameras import Camera
from pcbench.geometry.transform import robust_similarity
from pcbench.scenes import Scene
from pcbench.scenes.scene import first_names
from reconstructors.sfm.epipolar import MIN_STRONG_MATCHES, Agreement, ambiguity_warning, epipolar_agreement
from reconstructors.sfm.features import DATABASE
from reconstructors.sfm.mapping import Mapper, largest_component, map_images
from reconstructors.sfm.matches import remove_pairs
from reconstructors.sfm.model import Refine, cameras_of

_MAX_IMAGES_BOTH_MAPPERS = 30  # larger scenes are solved by one mapper
# Share of the pairs: if fewer agree, wrong ones may have moved a camera, and the strong pairs are also solved alone.
_MIN_AGREEING_PAIRS_SHARE = 0.9
# A camera's two positions differ significantly if their distance exceeds this many pixels of its view, and this
# multiple of the median distance of all cameras.
_MAX_SEPARATION_PX, _MAX_SEPARATION_MEDIANS = 2.0, 5.0


@dataclass(frozen=True, eq=False)
class SolvedModel:
    """Model of the images, its agreement with all verified pairs, and notes on what is left out.

    The agreement counts all verified pairs, whichever pairs the model was solved from.
    """

    method: str
    model: Any
    cameras: Mapping[str, Camera]
    agreement: Agreement
    notes: Sequence[str]

    @property
    def is_sound(self) -> bool:
        """Return whether hardly any strong pair contradicts the cameras."""
        return self.agreement.is_sound

    def describe(self) -> str:
        """Return one line on the method, the number of registered images and the contradicting pairs."""
        contradicting, strong = len(self.agreement.contradicting_pairs), len(self.agreement.strong_pairs)
        return (
            f"{self.method} registers {len(self.cameras)} images and is contradicted by {contradicting} of {strong}"
            " strong pairs"
        )


def solve(verified: Path, scene: Scene, workspace: Path, mapper: Mapper, refine: Refine, seed: int) -> SolvedModel:
    """Solve for the cameras and points of the largest component.

    Few images are solved by both mappers, and from strong pairs alone if many pairs are wrong; differences are
    reported. If strong pairs contradict the cameras, scenes of any size are solved again without these pairs, and from
    strong pairs alone: most wrong pairs from repeated structure are weak. `best_solution` selects the result.

    Args:
        verified: Stage with the verified matches.
        scene: Images.
        workspace: Folder of the stages.
        mapper: Requested mapping method.
        refine: Intrinsics to solve for.
        seed: Random seed.

    Raises:
        ReconstructionError: No two images could start a model in either method.
    """

    def solve_with(method: Mapper, matches: Path, description: str = "", name: str = "") -> SolvedModel:
        model, notes = largest_component(map_images(matches, scene, workspace, method, refine, seed, name), scene)
        cameras = cameras_of(model)
        return SolvedModel(
            f"{method} mapping{description}", model, cameras, epipolar_agreement(verified / DATABASE, cameras), notes
        )

    solutions = list[SolvedModel]()
    failures = list[Exception]()

    def try_solving(method: Mapper, matches: Path, description: str = "", name: str = "") -> None:
        # A mapper may find no start, or COLMAP may give up: another solution may still do.
        try:
            solutions.append(solve_with(method, matches, description, name))
        except (ReconstructionError, RuntimeError, ValueError) as error:
            failures.append(error)

    try_solving(mapper, verified)
    requested = solutions[0] if solutions else None
    is_cheap = len(scene) <= _MAX_IMAGES_BOTH_MAPPERS
    if is_cheap or requested is None:
        try_solving("global" if mapper == "incremental" else "incremental", verified)
    if not solutions:
        raise failures[0]
    best = best_solution(solutions)
    if not best.is_sound:
        pairs = [(pair.a, pair.b) for pair in best.agreement.contradicting_pairs]
        consistent = remove_pairs(verified, workspace, "consistent", dropped=pairs)
        try_solving(mapper, consistent, f" without {len(pairs)} contradicting pairs", "consistent-solved")
    if not best.is_sound or (is_cheap and best.agreement.share_of_pairs < _MIN_AGREEING_PAIRS_SHARE):
        strong_pairs = remove_pairs(verified, workspace, "strong", min_matches=MIN_STRONG_MATCHES)
        try_solving(
            "incremental", strong_pairs, f" from pairs of at least {MIN_STRONG_MATCHES} matches", "strong-solved"
        )
    best = best_solution(solutions)
    notes = [*best.notes]
    if requested is None:
        notes.append(f"{mapper} mapping fails ({failures[0]}); kept: {best.describe()}")
    elif best is not requested:
        notes.append(f"{requested.describe()}; kept: {best.describe()}")
    if best.is_sound:
        for other in solutions:
            if other is not best and (other.is_sound or best is requested):
                notes += describe_differences(best, other)
    return replace(
        best, notes=[*notes, best.agreement.describe("solved"), *ambiguity_warning(best.agreement, "solved")]
    )


def best_solution(solutions: Sequence[SolvedModel]) -> SolvedModel:
    """Return the sound solution with the most images, else the one that the fewest strong pairs contradict.

    Ties go to the first. Solutions with less than half of the images are ignored: hardly any pair is left to contradict
    them.
    """
    max_cameras = max(len(solution.cameras) for solution in solutions)
    large = [solution for solution in solutions if 2 * len(solution.cameras) >= max_cameras]
    if solutions[0].is_sound and solutions[0] in large:
        return solutions[0]
    sound = [solution for solution in large if solution.is_sound]
    if sound:
        return max(sound, key=lambda solution: len(solution.cameras))
    return min(large, key=lambda solution: len(solution.agreement.contradicting_pairs))


def describe_differences(best: SolvedModel, other: SolvedModel) -> list[str]:
    """Return a note on the cameras whose positions in another solution differ by more than the errors of both.

    Weakly constrained cameras, such as one that sees a single wall, get different positions from different mappers.
    Their distance is compared with the pixel size in their view and with the other cameras, because shared errors move
    all cameras by similar amounts.
    """
    names = [name for name in best.cameras if name in other.cameras]
    positions = [np.array([cameras[n].position for n in names]) for cameras in (other.cameras, best.cameras)]
    try:
        fit = robust_similarity(*positions)
    except InputError:  # fewer than three cameras, or all on one line
        return []
    separations = np.linalg.norm(fit.apply(positions[0]) - positions[1], axis=1)
    pixel_sizes = np.array([_pixel_size(best, name) for name in names])
    median = float(np.median(separations))
    if median > _MAX_SEPARATION_PX * float(np.median(pixel_sizes)):
        separation_text = f"the cameras {median:.3g} away (median), at most {separations.max():.3g}"
    else:
        is_separate = separations > np.maximum(_MAX_SEPARATION_PX * pixel_sizes, _MAX_SEPARATION_MEDIANS * median)
        if not is_separate.any():
            return []
        order = [int(k) for k in np.argsort(-separations) if is_separate[k]]
        named = first_names([f"{names[k]} {separations[k]:.3g}" for k in order])
        separation_text = f"{named} away, the others {median:.3g} (median): these cameras are weakly constrained"
    return [f"{other.describe()}, and puts {separation_text}"]


def _pixel_size(solution: SolvedModel, name: str) -> float:
    """Return the size of a camera's pixel at the median depth of its points, in the unit of the cameras."""
    model, camera = solution.model, solution.cameras[name]
    image = model.find_image_with_name(name)
    seen = [model.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
    if not seen:
        return 0.0
    return float(np.median(camera.cam_from_world.apply(np.array(seen))[:, 2])) / camera.intrinsics.fx
