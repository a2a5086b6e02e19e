"""Feature matches of image pairs, and the matches that agree on a two-view geometry."""

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
from pcbench.io.colmap_model import colmap_camera
from pcbench.plugins.progress import progress
from pcbench.plugins.stages import stage, stage_key
from pcbench.scenes import Scene
from pcbench.systems import cpu_count
from pcbench.threads import ONE_THREAD
from reconstructors.sfm.features import DATABASE, LensGroup, NoPointsError, shared_intrinsics

_MIN_INLIERS = 15  # inliers of a usable pair: COLMAP's default
_MIN_PAIRS_PER_PROCESS = 25  # a process takes 0.3 s to start, a pair 0.01 to 0.2 s
_MAX_PROCESSES = 8  # each has a copy of the database: about 1.3 MB per image


def match_pairs(features: Path, pairs: Sequence[tuple[str, str]], workspace: Path) -> Path:
    """Match pairs of images; return the stage's folder with a copy of the database of `features`.

    Args:
        features: Stage with the features.
        pairs: Pairs of image names.
        workspace: Folder of the stages.

    Raises:
        ReconstructionError: A matching process fails.
    """

    def make(folder: Path) -> None:
        shutil.copyfile(features / DATABASE, folder / DATABASE)
        names = _rename_images(folder / DATABASE, {})
        image_ids = {name: number for number, name in names.items()}
        id_pairs = [(image_ids[a], image_ids[b]) for a, b in pairs]
        processes = max(1, min(cpu_count(), _MAX_PROCESSES, len(pairs) // _MIN_PAIRS_PER_PROCESS))
        # Neighbouring pairs share an image: a process that gets them builds fewer indices.
        progress(f"matching {len(pairs):,} pairs of images")
        bounds = [len(pairs) * k // processes for k in range(processes + 1)]
        _match_in_processes(folder, [id_pairs[start:end] for start, end in pairwise(bounds)])
        _rename_images(folder / DATABASE, names)

    return stage(workspace, "matches", {"features": stage_key(features), "pairs": pairs}, make)


def _match_in_processes(folder: Path, parts: Sequence[Sequence[tuple[int, int]]]) -> None:
    """Match each part in a separate process on a copy of the database, and merge the matches."""
    import pycolmap

    def match_part(number: int) -> Path:
        copy = folder / f"part-{number}.db"
        shutil.copyfile(folder / DATABASE, copy)
        listed = _write_list(folder / f"pairs-{number}", parts[number])
        # COLMAP's libraries would otherwise use one thread per CPU, whatever COLMAP's own number of threads.
        process = run_module("reconstructors.sfm.match_child", str(copy), str(listed), environment=ONE_THREAD)
        if process.code != 0:
            print(process.errors, file=sys.stderr)  # into the run's log, as the last line alone is not informative
            raise ReconstructionError(f"COLMAP's matching failed with exit code {process.code}")
        return copy

    with ThreadPoolExecutor(len(parts)) as threads:
        copies = list(threads.map(match_part, range(len(parts))))
    database = pycolmap.Database.open(folder / DATABASE)
    for copy, part in zip(copies, parts, strict=True):
        part_database = pycolmap.Database.open(copy)
        for a, b in part:
            if part_database.exists_matches(a, b):
                database.write_matches(a, b, part_database.read_matches(a, b))
        part_database.close()
        copy.unlink()
    database.close()


def _write_list(file: Path, pairs: Sequence[tuple[int, int]]) -> Path:
    """Write a list of pairs in COLMAP's format by image ids, because COLMAP splits lines at spaces in names."""
    file.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    return file


def verify_matches(matches: Path, scene: Scene, workspace: Path, seed: int) -> Path:
    """Keep the matches that agree on a two-view geometry, with the scene's intrinsics if known; return the folder."""
    import pycolmap

    groups = shared_intrinsics(scene)

    def make(folder: Path) -> None:
        shutil.copyfile(matches / DATABASE, folder / DATABASE)
        _set_intrinsics(folder / DATABASE, groups)
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = seed
        progress("verifying matches")
        pycolmap.geometric_verification(folder / DATABASE, two_view_geometry_options=options)

    lenses = repr([tuple(group) for group in groups])
    return stage(workspace, "verified", {"matches": stage_key(matches), "lenses": lenses, "seed": seed}, make)


def check_verified(verified: Path, counts: Mapping[str, int]) -> None:
    """Check that at least one pair of images overlaps.

    Args:
        verified: Stage with the verified matches.
        counts: Number of features by image name.

    Raises:
        NoPointsError: No pair has enough verified matches.
    """
    import pycolmap

    database = pycolmap.Database.open(verified / DATABASE)
    _, inliers = database.read_two_view_geometry_num_inliers()
    database.close()
    if max(inliers, default=0) < _MIN_INLIERS:
        raise NoPointsError(
            f"no pair verified: {len(counts)} images have {int(np.median(list(counts.values())))} features (median),"
            " but no two images agree on a geometry: they show different scenes, or the overlap is too small"
        )


def remove_pairs(
    verified: Path, workspace: Path, name: str, dropped: Sequence[tuple[str, str]] = (), min_matches: int = 0
) -> Path:
    """Copy the verified matches without some pairs and pairs with fewer than `min_matches`; return the stage."""
    import pycolmap

    def make(folder: Path) -> None:
        shutil.copyfile(verified / DATABASE, folder / DATABASE)
        database = pycolmap.Database.open(folder / DATABASE)
        names = {int(image.image_id): str(image.name) for image in database.read_all_images()}
        dropped_pairs = {frozenset(pair) for pair in dropped}
        for pair, matches in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
            a, b = (int(number) for number in pycolmap.pair_id_to_image_pair(pair))
            if matches < min_matches or frozenset((names[a], names[b])) in dropped_pairs:
                database.delete_two_view_geometry(a, b)
                database.delete_matches(a, b)
        database.close()

    inputs = {"verified": stage_key(verified), "dropped": sorted(dropped), "least": min_matches}
    return stage(workspace, name, inputs, make)


def _set_intrinsics(database_file: Path, groups: Sequence[LensGroup]) -> None:
    """Set the known intrinsics of the images in a database."""
    import pycolmap

    intrinsics_by_name = {name: intrinsics for intrinsics, names in groups for name in names}
    database = pycolmap.Database.open(database_file)
    for number, name in sorted({image.camera_id: image.name for image in database.read_all_images()}.items()):
        if (k := intrinsics_by_name[name]) is not None:
            # Do not solve for more parameters than the given model has: square pixels stay square.
            model, parameters = "OPENCV", [k.fx, k.fy, k.cx, k.cy, *k.distortion]
            if k.fisheye or len(k.distortion) > 4:
                model, parameters = colmap_camera(k)
            elif k.fx == k.fy and not any(k.distortion[2:]):
                model, parameters = "RADIAL", [k.fx, k.cx, k.cy, *k.distortion[:2]]
            camera = pycolmap.Camera(camera_id=number, model=model, width=k.width, height=k.height, params=parameters)
            camera.has_prior_focal_length = True
            database.update_camera(camera)
    database.close()


def _rename_images(database_file: Path, names: Mapping[int, str]) -> dict[int, str]:
    """Rename the images in a database by id, to the id itself if no name is given; return the old names."""
    import pycolmap

    database = pycolmap.Database.open(database_file)
    old_names = {}
    for image in database.read_all_images():
        old_names[int(image.image_id)] = str(image.name)
        image.name = names.get(int(image.image_id), str(image.image_id))
        database.update_image(image)
    database.close()
    return old_names
