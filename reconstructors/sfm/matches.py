"""Matches between the features of image pairs, and those of them that agree on a two-view geometry."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np

from pcbench.children import run_module
from pcbench.errors import ReconstructionError
from pcbench.plugins.stages import stage, stage_key
from pcbench.scenes import Scene
from pcbench.systems import cpus
from reconstructors.sfm.features import DATABASE, Shared, shared_intrinsics

_MIN_INLIERS = 15  # of a pair that is used: COLMAP's default
_PAIRS_A_PROCESS = 25  # at least: a process takes 0.3 s to start, a pair 0.01 to 0.2 s
# Whatever COLMAP's own number of threads is, its libraries would take one for each CPU.
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_MAX_PROCESSES = 8  # each has a copy of the database: about 1.3 MB an image


def match_pairs(features: Path, pairs: Sequence[tuple[str, str]], workspace: Path) -> Path:
    """The stage with the matches of pairs of images, in a copy of the database of `features`.

    Raises:
        ReconstructionError: a process that matches breaks down.
    """

    def make(folder: Path) -> None:
        shutil.copyfile(features / DATABASE, folder / DATABASE)
        names = _rename(folder / DATABASE, {})
        numbers = {name: number for number, name in names.items()}
        numbered = [(numbers[a], numbers[b]) for a, b in pairs]
        processes = max(1, min(cpus(), _MAX_PROCESSES, len(pairs) // _PAIRS_A_PROCESS))
        # Neighbours in the list share an image: a process that gets them builds fewer indices.
        ends = [len(pairs) * k // processes for k in range(processes + 1)]
        _match_apart(folder, [numbered[start:end] for start, end in pairwise(ends)])
        _rename(folder / DATABASE, names)

    return stage(workspace, "matches", {"features": stage_key(features), "pairs": pairs}, make)


def _match_apart(folder: Path, parts: Sequence[Sequence[tuple[int, int]]]) -> None:
    """Match each part in a process of its own, on a copy of the database, and collect what they found."""
    import pycolmap

    def matched(number: int) -> Path:
        copy = folder / f"part-{number}.db"
        shutil.copyfile(folder / DATABASE, copy)
        listed = _write_list(folder / f"pairs-{number}", parts[number])
        ended = run_module("reconstructors.sfm.match_child", str(copy), str(listed), environment=_ONE_THREAD)
        if ended.code != 0:
            print(ended.errors, file=sys.stderr)  # into the run's log: its last line is one of a stack
            raise ReconstructionError(f"COLMAP's matching broke down: code {ended.code}")
        return copy

    with ThreadPoolExecutor(len(parts)) as threads:
        copies = list(threads.map(matched, range(len(parts))))
    database = pycolmap.Database.open(folder / DATABASE)
    for copy, part in zip(copies, parts, strict=True):
        found = pycolmap.Database.open(copy)
        for a, b in part:
            if found.exists_matches(a, b):
                database.write_matches(a, b, found.read_matches(a, b))
        found.close()
        copy.unlink()
    database.close()


def _write_list(file: Path, pairs: Sequence[tuple[int, int]]) -> Path:
    """A list of pairs as COLMAP reads it: it is cut at spaces, so the images' numbers stand for their names."""
    file.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    return file


def verify_matches(matches: Path, scene: Scene, workspace: Path, seed: int) -> Path:
    """The stage with the matches that agree on a geometry, under the scene's intrinsics where they are known."""
    import pycolmap

    groups = shared_intrinsics(scene)

    def make(folder: Path) -> None:
        shutil.copyfile(matches / DATABASE, folder / DATABASE)
        _set_intrinsics(folder / DATABASE, groups)
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = seed
        pycolmap.geometric_verification(folder / DATABASE, two_view_geometry_options=options)

    known = repr([tuple(group) for group in groups])
    return stage(workspace, "verified", {"matches": stage_key(matches), "lenses": known, "seed": seed}, make)


def check_verified(verified: Path, counts: Mapping[str, int]) -> None:
    """Say that no two images show the same scene.

    Args:
        counts: features by image name.

    Raises:
        ReconstructionError: no pair has enough verified matches.
    """
    import pycolmap

    database = pycolmap.Database.open(verified / DATABASE)
    _, inliers = database.read_two_view_geometry_num_inliers()
    database.close()
    if max(inliers, default=0) < _MIN_INLIERS:
        raise ReconstructionError(
            f"no pair verified: {len(counts)} images have {int(np.median(list(counts.values())))} features (median),"
            " but no two agree on a geometry: they show different things, or the overlap is too small"
        )


def without_pairs(
    verified: Path, workspace: Path, name: str, dropped: Sequence[tuple[str, str]] = (), least: int = 0
) -> Path:
    """The stage `name`: the verified matches without those of some pairs, and of pairs with fewer than `least`."""
    import pycolmap

    def make(folder: Path) -> None:
        shutil.copyfile(verified / DATABASE, folder / DATABASE)
        database = pycolmap.Database.open(folder / DATABASE)
        names = {int(image.image_id): str(image.name) for image in database.read_all_images()}
        unwanted = {frozenset(pair) for pair in dropped}
        for pair, matches in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
            a, b = (int(number) for number in pycolmap.pair_id_to_image_pair(pair))
            if matches < least or frozenset((names[a], names[b])) in unwanted:
                database.delete_two_view_geometry(a, b)
                database.delete_matches(a, b)
        database.close()

    inputs = {"verified": stage_key(verified), "dropped": sorted(dropped), "least": least}
    return stage(workspace, name, inputs, make)


def _set_intrinsics(database_file: Path, groups: Sequence[Shared]) -> None:
    """Give the known intrinsics to their images in a database."""
    import pycolmap

    known = {name: intrinsics for intrinsics, names in groups for name in names}
    database = pycolmap.Database.open(database_file)
    for number, name in sorted({image.camera_id: image.name for image in database.read_all_images()}.items()):
        if (k := known[name]) is not None:
            # What is solved for later should be no more than the given model has: pixels are square where they were.
            radial = k.fx == k.fy and not any(k.distortion[2:])
            model, numbers = "OPENCV", [k.fx, k.fy, k.cx, k.cy, *k.distortion]
            if radial:
                model, numbers = "RADIAL", [k.fx, k.cx, k.cy, *k.distortion[:2]]
            camera = pycolmap.Camera(camera_id=number, model=model, width=k.width, height=k.height, params=numbers)
            camera.has_prior_focal_length = True
            database.update_camera(camera)
    database.close()


def _rename(database_file: Path, names: Mapping[int, str]) -> dict[int, str]:
    """Give images in a database names by their numbers, where there is none the number itself; the names before."""
    import pycolmap

    database = pycolmap.Database.open(database_file)
    before = {}
    for image in database.read_all_images():
        before[int(image.image_id)] = str(image.name)
        image.name = names.get(int(image.image_id), str(image.image_id))
        database.update_image(image)
    database.close()
    return before
