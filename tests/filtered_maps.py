"""Filtered exact maps on disk, as `mvs` fuses them."""

from pathlib import Path

import numpy as np
from exact_maps import plane_map
from PIL import Image

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.plugins.stages import stage
from reconstructors.mvs.blocks import FilteredImage
from reconstructors.mvs.confidence import depth_percents
from reconstructors.mvs.filter import Criteria, filter_map
from reconstructors.mvs.fusion import sample_overlap
from reconstructors.mvs.maps import write_map

K = Intrinsics(160, 120, 150.0, 155.0, 81.0, 58.5)


def cameras_over_plane(count=5):
    """Return cameras along the x axis, 5 above the plane z = 0."""
    return [Camera(f"{k}/a b.jpg", K, look_at([0.5 * k, 0.4 * (k % 2), 5], [0.4 * k, 0, 0])) for k in range(count)]


def filter_maps(folder, cameras, maps, image=None) -> dict[str, FilteredImage]:
    """Filter maps against each other, with at least three images per depth, and store them as stages in a folder.

    `image` returns the photograph of a camera; by default that of the k-th camera is plain with grey value 10 + k.
    """
    filtered = {}
    for k, (camera, depth_map) in enumerate(zip(cameras, maps, strict=True)):
        others = [j for j in range(len(cameras)) if j != k]
        kept, agreement = filter_map(camera, depth_map, [(cameras[j], maps[j]) for j in others], Criteria(views=3))
        counts = np.where(kept.known, 1 + agreement.sum(axis=0), 0).astype(np.uint8)
        grey = np.full((camera.intrinsics.height, camera.intrinsics.width, 3), 10 + k, np.uint8)
        photograph = grey if image is None else image(camera)
        percents = depth_percents(camera, kept, agreement, [cameras[j] for j in others], photograph[..., 0])

        def make(path: Path, kept=kept, counts=counts, photograph=photograph, percents=percents) -> None:
            write_map(path, kept)
            np.save(path / "views.npy", counts)
            np.save(path / "percents.npy", percents)
            Image.fromarray(photograph).save(path / "image.png")

        path = stage(folder, f"map{k}", {"depths": float(kept.depth.sum())}, make)
        overlap = sample_overlap(camera, kept, agreement, [cameras[j].name for j in others])
        filtered[camera.name] = FilteredImage(
            camera, path / "image.png", path, path / "views.npy", path / "percents.npy", overlap, int(kept.known.sum())
        )
    return filtered


def filtered_plane(folder, count=5) -> dict[str, FilteredImage]:
    """Return the filtered maps of the plane z = 0."""
    cameras = cameras_over_plane(count)
    return filter_maps(folder, cameras, [plane_map(camera, (0, 0, 1), 0.0) for camera in cameras])
