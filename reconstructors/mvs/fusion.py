"""Filtered maps become one cloud: COLMAP's fusion in a workspace made for it, and Poisson's mesh of what it gives.

Fusion takes the centres of pixels for whole numbers, and COLMAP's models have them at halves: the model of the
workspace has its principal points shifted by half a pixel, and is for nobody else.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.io import read_cloud
from pcbench.io.meshes import read_mesh
from pcbench.scenes.synthetic.files import write_mesh_ply
from reconstructors.mvs.filter import world_points
from reconstructors.mvs.maps import DEPTH, NORMAL, DepthMap
from reconstructors.sfm.model import check_written, not_written

FUSED = "fused.ply"  # in the folder of the stage, with the images of each point in fused.ply.vis

_LINKS = 24  # samples along the longer side of a map that tell which images show the same
# Images that a pixel is looked for in, from the reference and from nowhere else. With room for these in the cache the
# memory does not depend on the number of images; and pixels side by side stay points side by side, where going on from
# what was found merges them within the reprojection error.
_NEIGHBOURS = 30
_FROM_REFERENCE = 2  # COLMAP's depth of traversal, which counts the reference
_BYTES = 19  # a pixel of a map in the cache: depth, normal and colour
_MIN_CACHE = 0.05  # GiB


class Track(NamedTuple):
    """A point (3,), and the numbers (N,), from 1, of the images that show it."""

    point: FloatArray
    images: IntArray


@dataclass(frozen=True, eq=False)
class Links:
    """Points of one map and the images that agree on them: they tell fusion which images overlap.

    Args:
        points: (N, 3), in the world.
        agree: (sources, N).
        sources: names of the sources.
    """

    points: FloatArray
    agree: NDArray[np.bool_]
    sources: Sequence[str]


def links(camera: Camera, made: DepthMap, agree: NDArray[np.bool_], sources: Sequence[str]) -> Links:
    """A map's points on a grid, of what is known there."""
    height, width = made.depth.shape
    step = max(1, max(height, width) // _LINKS)
    rows, columns = np.nonzero(made.known[step // 2 :: step, step // 2 :: step])
    rows, columns = step // 2 + step * rows, step // 2 + step * columns
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    return Links(world_points(camera, pixels, made.depth[rows, columns]), agree[:, rows, columns], tuple(sources))


def write_workspace(
    folder: Path, cameras: Mapping[str, Camera], images: Mapping[str, Path], tracks: Sequence[Track]
) -> None:
    """A dense workspace of COLMAP without maps; its images are links to where they lie, named by their numbers.

    Args:
        folder: exists and is empty.
        cameras, images: by image name: the pinhole, the undistorted photograph.
        tracks: points that tell which images overlap.
    """
    for part in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps"):
        (folder / part).mkdir(parents=True)
    for short, name in zip(short_names(cameras), cameras, strict=True):
        _link(folder / "images" / short, images[name])
    (folder / "stereo/fusion.cfg").write_text("".join(f"{short}\n" for short in short_names(cameras)))
    workspace_model(cameras, tracks).write(folder / "sparse")
    check_written(folder / "sparse")


def link_maps(folder: Path, maps: Mapping[str, Path]) -> None:
    """Put maps into a workspace: links to the files in their folders, by image name in the order of its cameras."""
    for short, made in zip(short_names(maps), maps.values(), strict=True):
        _link(folder / f"stereo/depth_maps/{short}.geometric.bin", made / DEPTH)
        _link(folder / f"stereo/normal_maps/{short}.geometric.bin", made / NORMAL)


def short_names(names: Collection[str]) -> list[str]:
    """The names of images in a workspace, in order: COLMAP's lists know no spaces and folders."""
    return [_short(number) for number in range(1, len(names) + 1)]


def workspace_model(cameras: Mapping[str, Camera], tracks: Sequence[Track]) -> Any:
    """COLMAP's model of a workspace, with principal points shifted by half a pixel; images have the numbers 1, 2, ... .

    Args:
        tracks: points that the images show.
    """
    import pycolmap

    model, at = pycolmap.Reconstruction(), {k: list[FloatArray]() for k in range(1, len(cameras) + 1)}
    elements = []
    for point, seen in tracks:
        elements.append([(k, len(at[k])) for k in seen.tolist()])
        for k in seen.tolist():
            at[k].append(point)
    for k, camera in enumerate(cameras.values(), start=1):
        i = camera.intrinsics
        parameters = [i.fx, i.fy, i.cx - 0.5, i.cy - 0.5]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=k, model="PINHOLE", width=i.width, height=i.height, params=parameters)
        )
        pixels = camera.project(np.array(at[k]).reshape(-1, 3))[0]
        image = pycolmap.Image(
            name=_short(k), camera_id=k, image_id=k, points2D=[pycolmap.Point2D(pixel) for pixel in pixels]
        )
        pose = camera.cam_from_world
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
        model.add_image_with_trivial_frame(image, rigid)
    for (point, _), places in zip(tracks, elements, strict=True):
        track = pycolmap.Track()
        for k, place in places:
            track.add_element(k, place)
        model.add_point3D(point, track)
    return model


def fuse(workspace: Path, out: Path, cameras: Mapping[str, Camera], normal_deg: float) -> None:
    """Write COLMAP's fused cloud and its .vis file. Every depth of a filtered map becomes part of a point: those that
    are one are merged, and none has to be confirmed again by pixels that are no part of another point yet.

    Args:
        workspace: as `write_workspace` and `link_maps` make it.
        normal_deg: between the normals of pixels that are merged, at most.

    Raises:
        ReconstructionError: a file could not be written whole, which COLMAP does not say.
    """
    import pycolmap

    options = pycolmap.StereoFusionOptions()
    options.num_threads = 1  # the same cloud again
    options.min_num_pixels = 1
    options.max_normal_error = normal_deg
    options.check_num_images = _NEIGHBOURS
    options.max_traversal_depth = _FROM_REFERENCE
    options.use_cache = True
    pixels = max(camera.intrinsics.width * camera.intrinsics.height for camera in cameras.values())
    options.cache_size = max(_MIN_CACHE, (_NEIGHBOURS + 4) * pixels * _BYTES / 2**30)
    pycolmap.stereo_fusion(out, workspace, input_type="geometric", options=options, output_type="PLY")
    try:
        if len(visibility(_visibility_file(out))[0]):  # a cloud without points is said later
            read_cloud(out, on_warning=lambda _: None)
    except (InputError, OSError) as error:
        raise not_written(out) from error


def read_fused(path: Path, cameras: Mapping[str, Camera], counts: Mapping[str, Path], least: int) -> Cloud:
    """The fused cloud in the frame that it was fused in, with normals, colours and the attribute `views`: the number of
    images that agree on a point, as the filter counted it at that of its pixels where it is largest.

    Args:
        cameras: by image name, in the order of the workspace.
        counts: by image name: an .npy file with the number (H, W) of images that agree at each pixel.
        least: images that agree on every point, by the filter.

    Raises:
        ReconstructionError: nothing was fused.
    """
    point, image = visibility(_visibility_file(path))
    if not len(point):
        raise ReconstructionError(
            "nothing is fused: no depth is confirmed by enough images; take more images with more overlap, check the"
            " cameras, or ask for less (--set confidence, --set views)"
        )
    cloud = read_cloud(path, on_warning=lambda _: None)
    # The median of merged pixels may lie in the next pixel, of which nothing is known.
    views = np.full(len(cloud), least, dtype=np.int32)
    for k, (name, camera) in enumerate(cameras.items()):
        here, count = point[image == k], np.load(counts[name])
        u, v = camera.project(cloud.points[here])[0].T
        row = np.clip(v, 0, count.shape[0] - 1).astype(np.int64)
        column = np.clip(u, 0, count.shape[1] - 1).astype(np.int64)
        views[here] = np.maximum(views[here], count[row, column])
    return replace(cloud, attributes={"views": views})


def visibility(path: Path) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Numbers of points and of images (M,), a pair for each image that a point comes from, of a .vis file of COLMAP:
    the uint64 number of points, then each point's uint32 count and so many uint32 numbers of images, from 0.

    Raises:
        InputError: the file was cut short.
    """
    words = np.fromfile(path, dtype="<u4")
    if len(words) < 2 or len(words) < 2 + (count := int(words[:2].view("<u8")[0])):
        raise InputError(f"{path}: truncated")
    # A view, and no list: that would take ten times the memory of the file.
    numbers, starts, place = words.data, np.empty(count, dtype=np.int64), 2
    for point in range(count):
        if place >= len(words):
            raise InputError(f"{path}: truncated")
        starts[point] = place
        place += 1 + numbers[place]
    if place > len(words):
        raise InputError(f"{path}: truncated")
    lengths = words[starts]
    is_image = np.ones(place, dtype=np.bool_)
    is_image[:2] = is_image[starts] = False
    return np.repeat(np.arange(count, dtype=np.int32), lengths), words[:place][is_image].view(np.int32)


def _visibility_file(fused: Path) -> Path:
    return fused.with_name(fused.name + ".vis")


def tracks_of(found: Mapping[str, Links], cameras: Collection[str]) -> list[Track]:
    """The tracks that the links of images, by name, make among the cameras."""
    number = {name: k for k, name in enumerate(cameras, start=1)}
    tracks = []
    for name, link in found.items():
        others = np.array([number[source] for source in link.sources], dtype=np.int64)
        for point, agree in zip(link.points, link.agree.T, strict=True):
            tracks.append(Track(point, np.append(number[name], others[agree])))
    return tracks


def _short(number: int) -> str:
    return f"{number:06d}.png"


def _link(path: Path, target: Path) -> None:
    """A relative one, to a place beside the folder of the stage: that is renamed once it is complete."""
    path.symlink_to(os.path.relpath(target.absolute(), path.parent.absolute()))


def write_mesh(fused: Path, out: Path, origin: FloatArray, unit: str | None) -> int:
    """Write Poisson's mesh (Kazhdan and Hoppe 2013) of a fused cloud as PLY, in the world; the number of its faces.

    Raises:
        ReconstructionError: there is none.
    """
    import pycolmap

    # An octree as deep as the points are dense, were they spread evenly; and surface is left where they are this dense
    # but for three levels, not where it was made up to close holes.
    count = int(np.fromfile(_visibility_file(fused), dtype="<u8", count=1)[0])
    depth = int(np.clip(np.ceil(0.5 * np.log2(count)), 6, 13))
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim = depth, float(depth - 3)
    options.num_threads = 1
    raw = out.with_name(f".{out.name}")
    try:
        pycolmap.poisson_meshing(fused, raw, options)
        mesh = read_mesh(raw)
    except (RuntimeError, ValueError) as error:
        raise ReconstructionError(f"no mesh: {' '.join(str(error).split())}") from error
    finally:
        raw.unlink(missing_ok=True)
    write_mesh_ply(out, Mesh(mesh.vertices + origin, mesh.faces, unit=unit))
    return len(mesh)
