"""SIFT features of a scene's images, in COLMAP's database."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Intrinsics
from pcbench.io.image_header import JPEG_AND_PNG
from pcbench.plugins.progress import progress
from pcbench.plugins.stages import stage
from pcbench.scenes import Scene
from pcbench.scenes.decode import decode_luminance
from pcbench.scenes.scene import first_names
from pcbench.systems import cpu_count
from reconstructors.sfm.contrast import stretch_contrast

DATABASE = "database.db"  # file name in each stage's folder
_STRETCHED = "stretched.json"  # in the features' stage: names of the images whose contrast was stretched
_BATCH_PER_CPU = 4  # images between two reports of progress
MIN_FEATURES = 50  # per image: with fewer, hardly any pair has enough matches after ratio test and RANSAC


class NoPointsError(ReconstructionError):
    """The photographs do not determine any point: they have too few features, matches or overlap."""


class LensGroup(NamedTuple):
    """Images with the same intrinsics, which are None if unknown."""

    intrinsics: Intrinsics | None
    names: tuple[str, ...]


def extract_features(scene: Scene, workspace: Path, max_features: int, *, upsample: bool) -> Path:
    """Extract features of all images; return the stage's folder with the database.

    The contrast of dark and faint images is stretched first, only for the features.

    Args:
        scene: Images and known cameras.
        workspace: Folder of the stages.
        max_features: Maximum number of features per image.
        upsample: Whether to detect features at twice the image size too.
    """
    import pycolmap

    groups = shared_intrinsics(scene)

    def make(folder: Path) -> None:
        images, database = working_images(scene, workspace), folder / DATABASE
        masks = _write_masks(scene, folder)
        pycolmap.Database.open(database).close()
        # Import first, which fixes the image ids: extraction on several threads would shuffle them.
        for _, names in groups:
            pycolmap.import_images(database, images, camera_mode=pycolmap.CameraMode.SINGLE, image_names=list(names))
        reader = pycolmap.ImageReaderOptions()
        if masks is not None:
            reader.mask_path = str(masks)
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.sift.max_num_features = max_features
        extraction.sift.first_octave = -1 if upsample else 0
        stretched = folder / "stretched"
        faint = _write_stretched(scene, stretched)
        extracted = 0
        sufficient = [name for name in scene.images if name not in faint]
        for source, chosen in ((images, sufficient), (stretched, faint)):
            size = _BATCH_PER_CPU * cpu_count()
            for part in (chosen[start : start + size] for start in range(0, len(chosen), size)):
                pycolmap.extract_features(
                    database,
                    source,
                    image_names=part,
                    reader_options=reader,
                    extraction_options=extraction,
                    device=pycolmap.Device.cpu,
                )
                extracted += len(part)
                progress(f"finding features: {extracted} of {len(scene)} images")
        shutil.rmtree(stretched, ignore_errors=True)
        (folder / _STRETCHED).write_text(json.dumps(faint), encoding="utf-8")

    inputs = {
        "pycolmap": pycolmap.__version__,
        "scene": scene.fingerprint(cameras=False),
        "sharing a lens": [names for _, names in groups],
        "features": max_features,
        "upsample": upsample,
    }
    return stage(workspace, "features", inputs, make)


def shared_intrinsics(scene: Scene) -> list[LensGroup]:
    """Group the images by their intrinsics, or by their size if these are unknown."""
    names_by_lens: dict[Any, list[str]] = {}
    for name in scene.images:
        camera = scene.cameras.get(name)
        known_intrinsics = camera.intrinsics if camera else scene.intrinsics.get(name)
        names_by_lens.setdefault(known_intrinsics or scene.size(name), []).append(name)
    return [
        LensGroup(key if isinstance(key, Intrinsics) else None, tuple(names)) for key, names in names_by_lens.items()
    ]


def working_images(scene: Scene, workspace: Path) -> Path:
    """Return the folder of the images for COLMAP: the originals, or a stage with smaller or converted ones."""
    if scene.image_scale == 1 and all(name.lower().endswith(JPEG_AND_PNG) for name in scene.images):
        return scene.folder
    inputs = {"scene": scene.fingerprint(cameras=False), "exif": True}
    return stage(workspace, "images", inputs, lambda folder: scene.write_images(folder))


def _write_stretched(scene: Scene, folder: Path) -> list[str]:
    """Write the images of low contrast, stretched, in grey; return their names."""
    from PIL import Image

    faint = []
    for name in scene.images:
        stretched = stretch_contrast(decode_luminance(scene.folder / name, scene.size(name)))
        if stretched is not None:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            # PNG for any name: COLMAP recognizes the format by its content, and JPEG would add noise.
            Image.fromarray(stretched).save(folder / name, format="PNG", compress_level=1)
            faint.append(name)
    return faint


def describe_stretched(features: Path) -> list[str]:
    """Return a note on the images whose contrast was stretched for the features, if there are any."""
    names = json.loads((features / _STRETCHED).read_text(encoding="utf-8"))
    if not names:
        return []
    return [f"{len(names)} dark or faint images: their contrast is stretched to find features: {first_names(names)}"]


def _write_masks(scene: Scene, folder: Path) -> Path | None:
    """Write the masks at the working size under the names that COLMAP expects; None if no image has a mask.

    Pixels that are at least half transparent are masked too.
    """
    from PIL import Image

    if not (scene.masks or scene.with_alpha):
        return None
    for name in scene.images:
        path = folder / "masks" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        mask = scene.read_mask(name)
        if mask is None:  # COLMAP finds no features in an image whose mask is missing
            width, height = scene.size(name)
            mask = np.ones((height, width), dtype=bool)
        Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0))).save(path)
    return folder / "masks"


def count_features(features: Path) -> dict[str, int]:
    """Return the number of features by image name."""
    import pycolmap

    database = pycolmap.Database.open(features / DATABASE)
    counts = {image.name: int(database.num_keypoints_for_image(image.image_id)) for image in database.read_all_images()}
    database.close()
    return counts


def check_features(counts: Mapping[str, int], scene: Scene) -> list[str]:
    """Return notes on images with too few features.

    Args:
        counts: Number of features by image name.
        scene: Images.

    Raises:
        NoPointsError: Fewer than two images have enough features.
    """
    too_few = [name for name in scene.images if counts.get(name, 0) < MIN_FEATURES]
    if not too_few:
        return []
    if len(scene) - len(too_few) < 2:
        raise NoPointsError(
            f"too few features: {len(too_few)} of {len(scene)} images have fewer than {MIN_FEATURES}"
            f" ({too_few[0]}: {counts.get(too_few[0], 0)}): the images are blank, blurred, masked or too small"
        )
    return [f"{len(too_few)} of {len(scene)} images have fewer than {MIN_FEATURES} features: {first_names(too_few)}"]
