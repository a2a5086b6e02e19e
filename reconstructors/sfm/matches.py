"""Matches between the features of image pairs, and those of them that agree on a two-view geometry."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.plugins.stages import stage, stage_key
from pcbench.scenes import Scene
from reconstructors.sfm.features import DATABASE, Shared, shared_intrinsics

_MIN_INLIERS = 15  # of a pair that is used: COLMAP's default


def match_pairs(features: Path, pairs: Sequence[tuple[str, str]], workspace: Path) -> Path:
    """The stage with the matches of pairs of images, in a copy of the database of `features`."""
    import pycolmap

    def make(folder: Path) -> None:
        shutil.copyfile(features / DATABASE, folder / DATABASE)
        names = _rename(folder / DATABASE, {})
        numbers = {name: number for number, name in names.items()}
        # COLMAP's list of pairs is cut at spaces: it gets the images' numbers for names.
        lines = [f"{numbers[a]} {numbers[b]}\n" for a, b in pairs]
        (folder / "pairs.txt").write_text("".join(lines), encoding="utf-8")
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(folder / "pairs.txt")
        options = pycolmap.FeatureMatchingOptions()
        options.skip_geometric_verification = True
        pycolmap.match_image_pairs(
            folder / DATABASE, matching_options=options, pairing_options=pairing, device=pycolmap.Device.cpu
        )
        _rename(folder / DATABASE, names)

    return stage(workspace, "matches", {"features": stage_key(features), "pairs": pairs}, make)


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
