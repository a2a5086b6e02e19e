"""Repeated facades: `python benchmarks/courtyard.py` solves courtyards with each mapper.

It prints the mapper's own result, the accepted result and the warnings. Errors are those of the worst camera after an
alignment to the truth.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import courtyard

from pcbench.errors import ReconstructionError
from pcbench.geometry.transform import robust_similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.scenes import Scene, read_scene
from reconstructors.sfm.alignment import camera_errors, transform_camera
from reconstructors.sfm.epipolar import epipolar_agreement
from reconstructors.sfm.features import DATABASE
from reconstructors.sfm.mapping import largest_component, map_images
from reconstructors.sfm.model import cameras_of
from reconstructors.sfm.sfm import ColmapSfm


class Case(NamedTuple):
    """A courtyard to solve."""

    unique_share: float  # share of each wall's texture that is unique
    inwards: bool  # whether the cameras look across the court instead of outwards from its middle
    known_intrinsics: bool  # whether the intrinsics are known
    seed: int


def cases(seeds: list[int], unique_shares: list[float]) -> Iterator[Case]:
    """Yield all combinations."""
    for seed in seeds:
        for unique_share in unique_shares:
            for inwards in (False, True):
                for known_intrinsics in (False, True):
                    yield Case(unique_share, inwards, known_intrinsics, seed)


def photograph_scene(case: Case, folder: Path) -> Scene:
    """Render the images of a case and read them as a scene."""
    (folder / "images").mkdir()
    cameras = courtyard.cameras(30, courtyard.standard_intrinsics(), case.inwards)
    for camera in cameras:
        Image.fromarray(courtyard.photograph(camera, case.unique_share, case.seed)).save(
            folder / "images" / camera.name
        )
    write_colmap_model(folder / "sparse", cameras)
    return read_scene(folder, cameras="auto" if case.known_intrinsics else "none")


def worst_camera(solved, truth) -> str:
    """Return the number of solved cameras and the largest errors of position and direction."""
    names = sorted(solved)
    fit = robust_similarity(*(np.array([cameras[name].position for name in names]) for cameras in (solved, truth)))
    positions, angles = camera_errors({name: transform_camera(camera, fit) for name, camera in solved.items()}, truth)
    return f"{len(names)}: {positions.max():.3f} m, {angles.max():.1f} deg"


def rows(case: Case) -> Iterator[str]:
    """Yield a table row per mapper."""
    with tempfile.TemporaryDirectory() as temporary:
        folder, work = Path(temporary), Path(temporary) / "work"
        work.mkdir()
        scene = photograph_scene(case, folder)
        truth, refine = read_scene(folder).cameras, "none" if case.known_intrinsics else "all"
        for mapping in ("incremental", "global"):
            settings = {"poses": "solve", "refine": refine, "align": "none", "upsample": False, "features": 4000}
            view, lens = "across" if case.inwards else "outwards", ", known lens" if case.known_intrinsics else ""
            case_label = f"{case.unique_share:g} {view}{lens}"
            row_start = f"| {case_label} | {case.seed} | "
            try:
                reconstruction = ColmapSfm(mapping=mapping, **settings).reconstruct(scene, work)
            except ReconstructionError:
                yield f"{row_start}- | {mapping} | nothing | - | nothing | - | error |"
                continue

            def contradictions(cameras) -> int:
                return len(epipolar_agreement(work / "verified" / DATABASE, cameras).contradicting_pairs)

            model, _ = largest_component(map_images(work / "verified", scene, work, mapping, refine, 0), scene)
            mapper_result = f"{worst_camera(cameras_of(model), truth)} | {contradictions(cameras_of(model))}"
            warning_note = "warned" if any(note.startswith("warning: ") for note in reconstruction.notes) else "-"
            cameras = reconstruction.cameras
            accepted = f"{worst_camera(cameras, truth)} | {contradictions(cameras)} | {warning_note}"
            yield f"{row_start}{contradictions(truth)} | {mapping} | {mapper_result} | {accepted} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1])
    parser.add_argument("--own", type=float, nargs="*", default=[0.1, 0.2, 0.3])
    arguments = parser.parse_args()
    print(
        "| own texture, view, lens | seed | true cameras against | mapping | alone | against | kept | against | said |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for case in cases(arguments.seeds, arguments.own):
        for row in rows(case):
            print(row, flush=True)
