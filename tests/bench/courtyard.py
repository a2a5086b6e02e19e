"""Repeated facades: `python tests/bench/courtyard.py` solves courtyards, and prints what each mapper alone makes of
them, what is kept, and what is said. Errors are of the camera that is furthest off, after an alignment to the truth.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))
import courtyard

from pcbench.errors import ReconstructionError
from pcbench.geometry.transform import robust_similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.scenes import Scene, read_scene
from reconstructors.sfm.alignment import camera_errors, moved
from reconstructors.sfm.epipolar import agreement
from reconstructors.sfm.features import DATABASE
from reconstructors.sfm.mapping import largest_component, map_images
from reconstructors.sfm.model import cameras_of
from reconstructors.sfm.sfm import ColmapSfm


class Case(NamedTuple):
    own: float  # share of each wall's texture that no other place has
    inwards: bool  # the cameras look across the court, or out from its middle
    known: bool  # the intrinsics
    seed: int


def cases(seeds: list[int], owns: list[float]) -> Iterator[Case]:
    for seed in seeds:
        for own in owns:
            for inwards in (False, True):
                for known in (False, True):
                    yield Case(own, inwards, known, seed)


def photographed(case: Case, folder: Path) -> Scene:
    (folder / "images").mkdir()
    cameras = courtyard.cameras(30, courtyard.standard_intrinsics(), case.inwards)
    for camera in cameras:
        Image.fromarray(courtyard.photograph(camera, case.own, case.seed)).save(folder / "images" / camera.name)
    write_colmap_model(folder / "sparse", cameras)
    return read_scene(folder, cameras="auto" if case.known else "none")


def furthest(found, truth) -> str:
    names = sorted(found)
    fit = robust_similarity(*(np.array([cameras[name].position for name in names]) for cameras in (found, truth)))
    positions, angles = camera_errors({name: moved(camera, fit) for name, camera in found.items()}, truth)
    return f"{len(names)}: {positions.max():.3f} m, {angles.max():.1f} deg"


def rows(case: Case) -> Iterator[str]:
    with tempfile.TemporaryDirectory() as temporary:
        folder, work = Path(temporary), Path(temporary) / "work"
        work.mkdir()
        scene = photographed(case, folder)
        truth, refine = read_scene(folder).cameras, "none" if case.known else "all"
        for mapping in ("incremental", "global"):
            settings = {"poses": "solve", "refine": refine, "align": "none", "upsample": False, "features": 4000}
            what = f"{case.own:g} {'across' if case.inwards else 'outwards'}{', known lens' if case.known else ''}"
            start = f"| {what} | {case.seed} | "
            try:
                made = ColmapSfm(mapping=mapping, **settings).reconstruct(scene, work)
            except ReconstructionError:
                yield f"{start}- | {mapping} | nothing | - | nothing | - | error |"
                continue

            def against(cameras) -> int:
                return len(agreement(work / "verified" / DATABASE, cameras).contradicting_pairs)

            model, _ = largest_component(map_images(work / "verified", scene, work, mapping, refine, 0), scene)
            alone = f"{furthest(cameras_of(model), truth)} | {against(cameras_of(model))}"
            said = "warned" if any(note.startswith("warning: ") for note in made.notes) else "-"
            kept = f"{furthest(made.cameras, truth)} | {against(made.cameras)} | {said}"
            yield f"{start}{against(truth)} | {mapping} | {alone} | {kept} |"


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
