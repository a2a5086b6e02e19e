"""Fusion of filtered maps into one cloud by COLMAP, and Poisson meshing of the cloud.

Fusion expects pixel centres at integer coordinates, while COLMAP's models have them at +0.5. The workspace's model
therefore has its principal points shifted by half a pixel and serves fusion only.
"""

from __future__ import annotations

import os
import re
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
from pcbench.io.ply import write_ply_mesh
from reconstructors.mvs.confidence import SCORE
from reconstructors.mvs.filter import world_points
from reconstructors.mvs.maps import DEPTH, NORMAL, DepthMap
from reconstructors.sfm.model import check_written, truncated_output_error

VIEWS = "views"  # attribute of a cloud: number of images that agree on a point
FUSED = "fused.ply"  # in the folder of the stage, with the images of each point in fused.ply.vis

_OVERLAP_SAMPLES_PER_SIDE = 24  # samples along the longer side of a map that show which images overlap
# Each pixel is looked up in this many images, starting from the reference only. The cache holds these images, so memory
# does not grow with the number of images. Adjacent pixels also stay separate points; traversing further from found
# pixels would merge them within the reprojection error.
_MAX_NEIGHBOR_IMAGES = 30
_MAX_TRAVERSAL_DEPTH = 2  # COLMAP's traversal depth, which includes the reference
_BYTES_PER_PIXEL = 19  # of a map in the cache: depth, normal and colour
_MIN_CACHE_GIB = 0.05


class Track(NamedTuple):
    """A point (3,), and the ids (N,), starting at 1, of the images that observe it."""

    point: FloatArray
    image_ids: IntArray


@dataclass(frozen=True, eq=False)
class OverlapSamples:
    """Points of one map and the images that agree on them, from which fusion derives which images overlap.

    Args:
        points: (N, 3), in world coordinates.
        agreement: (sources, N), True if a source agrees on a point.
        sources: names of the sources.
    """

    points: FloatArray
    agreement: NDArray[np.bool_]
    sources: Sequence[str]

    def restrict(self, names: Collection[str]) -> OverlapSamples:
        """Return the samples with only those sources that are among the names."""
        used = [k for k, name in enumerate(self.sources) if name in names]
        return OverlapSamples(self.points, self.agreement[used], tuple(self.sources[k] for k in used))


def sample_overlap(
    camera: Camera, depth_map: DepthMap, agree: NDArray[np.bool_], sources: Sequence[str]
) -> OverlapSamples:
    """Sample a map's points on a regular pixel grid, with the sources that agree on them."""
    height, width = depth_map.depth.shape
    step = max(1, max(height, width) // _OVERLAP_SAMPLES_PER_SIDE)
    rows, columns = np.nonzero(depth_map.known[step // 2 :: step, step // 2 :: step])
    rows, columns = step // 2 + step * rows, step // 2 + step * columns
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    points = world_points(camera, pixels, depth_map.depth[rows, columns])
    return OverlapSamples(points, agree[:, rows, columns], tuple(sources))


def write_workspace(
    folder: Path, cameras: Mapping[str, Camera], images: Mapping[str, Path], tracks: Sequence[Track]
) -> None:
    """Write a dense COLMAP workspace without maps; its images are links to the originals, named by their ids.

    Args:
        folder: an existing, empty folder.
        cameras: pinholes by image name.
        images: paths of the undistorted photographs by image name.
        tracks: points that show which images overlap.
    """
    for part in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps"):
        (folder / part).mkdir(parents=True)
    for short, name in zip(short_names(cameras), cameras, strict=True):
        _link(folder / "images" / short, images[name])
    (folder / "stereo/fusion.cfg").write_text("".join(f"{short}\n" for short in short_names(cameras)))
    build_workspace_model(cameras, tracks).write(folder / "sparse")
    check_written(folder / "sparse")


def link_maps(folder: Path, maps: Mapping[str, Path]) -> None:
    """Link maps into a workspace.

    Args:
        folder: the workspace.
        maps: folders of the maps by image name, in the order of the workspace's cameras.
    """
    for short, source in zip(short_names(maps), maps.values(), strict=True):
        _link(folder / f"stereo/depth_maps/{short}.geometric.bin", source / DEPTH)
        _link(folder / f"stereo/normal_maps/{short}.geometric.bin", source / NORMAL)


def short_names(names: Collection[str]) -> list[str]:
    """Return the file names of images in a workspace, in order; COLMAP's lists allow no spaces and folders in names."""
    return [_short_name(number) for number in range(1, len(names) + 1)]


def build_workspace_model(cameras: Mapping[str, Camera], tracks: Sequence[Track]) -> Any:
    """Build COLMAP's model of a workspace, with principal points shifted by half a pixel and image ids 1, 2, ... .

    Args:
        cameras: pinholes by image name.
        tracks: points that the images observe.
    """
    import pycolmap

    model, observed = pycolmap.Reconstruction(), {k: list[FloatArray]() for k in range(1, len(cameras) + 1)}
    elements = []
    for point, image_ids in tracks:
        elements.append([(k, len(observed[k])) for k in image_ids.tolist()])
        for k in image_ids.tolist():
            observed[k].append(point)
    for k, camera in enumerate(cameras.values(), start=1):
        i = camera.intrinsics
        parameters = [i.fx, i.fy, i.cx - 0.5, i.cy - 0.5]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=k, model="PINHOLE", width=i.width, height=i.height, params=parameters)
        )
        pixels = camera.project(np.array(observed[k]).reshape(-1, 3))[0]
        image = pycolmap.Image(
            name=_short_name(k), camera_id=k, image_id=k, points2D=[pycolmap.Point2D(pixel) for pixel in pixels]
        )
        pose = camera.cam_from_world
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
        model.add_image_with_trivial_frame(image, rigid)
    for (point, _), observations in zip(tracks, elements, strict=True):
        track = pycolmap.Track()
        for k, point2d_index in observations:
            track.add_element(k, point2d_index)
        model.add_point3D(point, track)
    return model


def fuse(workspace: Path, out: Path, cameras: Mapping[str, Camera], normal_deg: float) -> None:
    """Write COLMAP's fused cloud and its .vis file.

    The maps are filtered already: each depth becomes part of a point, and depths of one point are merged. A point may
    consist of a single pixel, because its other pixels may be part of earlier points.

    Args:
        workspace: a folder that `write_workspace` and `link_maps` have filled.
        out: the .ply file to write.
        cameras: pinholes by image name.
        normal_deg: maximum angle between the normals of merged pixels.

    Raises:
        ReconstructionError: a file was not written completely, which COLMAP does not report.
    """
    import pycolmap

    options = pycolmap.StereoFusionOptions()
    options.num_threads = 1  # for repeatable results
    options.min_num_pixels = 1
    options.max_normal_error = normal_deg
    options.check_num_images = _MAX_NEIGHBOR_IMAGES
    options.max_traversal_depth = _MAX_TRAVERSAL_DEPTH
    options.use_cache = True
    pixels = max(camera.intrinsics.width * camera.intrinsics.height for camera in cameras.values())
    options.cache_size = max(_MIN_CACHE_GIB, (_MAX_NEIGHBOR_IMAGES + 4) * pixels * _BYTES_PER_PIXEL / 2**30)
    pycolmap.stereo_fusion(out, workspace, input_type="geometric", options=options, output_type="PLY")
    try:
        if len(read_visibility(_visibility_path(out))[0]):  # `read_fused` reports a cloud without points
            read_cloud(out, on_warning=lambda _: None)
    except (InputError, OSError) as error:
        raise truncated_output_error(out) from error


def read_fused(
    path: Path,
    cameras: Mapping[str, Camera],
    counts: Mapping[str, Path],
    percents: Mapping[str, Path],
    min_views: int,
) -> Cloud:
    """Read a fused cloud with points in the workspace's frame, with normals, colours, `views` and `score`.

    `views` is the number of images that agree on a point: the largest count of the filter at the point's pixels.
    `score` is the mean at these pixels, from 0 to 1.

    Args:
        path: the fused .ply file.
        cameras: pinholes by image name, in the order of the workspace.
        counts: .npy files by image name with the number (H, W) of images that agree at each pixel.
        percents: .npy files by image name with the score (H, W) of each depth in percent; 0 without a depth.
        min_views: minimum number of images that agree on a point, by the filter's criteria.

    """
    point, image = read_visibility(_visibility_path(path))
    cloud = read_cloud(path, on_warning=lambda _: None)
    # The median of merged pixels may fall into a neighbouring pixel without a depth.
    views = np.full(len(cloud), min_views, dtype=np.int32)
    percent_sums, depths = np.zeros(len(cloud), dtype=np.int64), np.zeros(len(cloud), dtype=np.int64)
    for k, (name, camera) in enumerate(cameras.items()):
        here, count, percent = point[image == k], np.load(counts[name]), np.load(percents[name])
        u, v = camera.project(cloud.points[here])[0].T
        row = np.clip(v, 0, count.shape[0] - 1).astype(np.int64)
        column = np.clip(u, 0, count.shape[1] - 1).astype(np.int64)
        views[here] = np.maximum(views[here], count[row, column])
        percent_sums[here] += percent[row, column]
        depths[here] += count[row, column] > 0
    scores = (percent_sums / (100 * np.maximum(depths, 1))).astype(np.float32)
    return replace(cloud, attributes={VIEWS: views, SCORE: scores})


def count_fused(path: Path) -> int:
    """Return the number of points of a fused .ply file; 0 if there is no file."""
    visibility = _visibility_path(path)
    return int(np.fromfile(visibility, dtype="<u8", count=1)[0]) if visibility.is_file() else 0


def read_visibility(path: Path) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Read COLMAP's .vis file: indices of points and of images, (M,) each, one pair for each image of a point.

    The file holds the uint64 number of points, then for each point a uint32 count and as many uint32 image indices,
    starting at 0.

    Raises:
        InputError: the file is truncated.
    """
    words = np.fromfile(path, dtype="<u4")
    if len(words) < 2 or len(words) < 2 + (count := int(words[:2].view("<u8")[0])):
        raise InputError(f"{path}: truncated")
    # A memoryview instead of a list, which would need ten times the memory of the file.
    numbers, starts, position = words.data, np.empty(count, dtype=np.int64), 2
    for point in range(count):
        if position >= len(words):
            raise InputError(f"{path}: truncated")
        starts[point] = position
        position += 1 + numbers[position]
    if position > len(words):
        raise InputError(f"{path}: truncated")
    lengths = words[starts]
    is_image = np.ones(position, dtype=np.bool_)
    is_image[:2] = is_image[starts] = False
    return np.repeat(np.arange(count, dtype=np.int32), lengths), words[:position][is_image].view(np.int32)


def _visibility_path(fused: Path) -> Path:
    return fused.with_name(fused.name + ".vis")


def build_tracks(overlaps: Mapping[str, OverlapSamples], cameras: Collection[str]) -> list[Track]:
    """Build tracks from the overlap samples of images, by image name; image ids follow the order of the cameras."""
    ids = {name: k for k, name in enumerate(cameras, start=1)}
    tracks = []
    for name, overlap in overlaps.items():
        others = np.array([ids[source] for source in overlap.sources], dtype=np.int64)
        for point, agree in zip(overlap.points, overlap.agreement.T, strict=True):
            tracks.append(Track(point, np.append(ids[name], others[agree])))
    return tracks


def _short_name(image_id: int) -> str:
    return f"{image_id:06d}.png"


def _link(path: Path, target: Path) -> None:
    """Create a relative link to a file outside the stage's folder, which is renamed once it is complete."""
    path.symlink_to(os.path.relpath(target.absolute(), path.parent.absolute()))


def write_mesh(fused: Sequence[Path], out: Path, origin: FloatArray, unit: str | None) -> int:
    """Write a Poisson mesh (Kazhdan and Hoppe 2013) of fused clouds, in world coordinates; return its face count.

    Args:
        fused: the fused .ply files.
        out: the .ply file to write.
        origin: world coordinates (3,) of the fused clouds' origin.
        unit: unit of the coordinates.

    Raises:
        ReconstructionError: meshing failed.
    """
    import pycolmap

    # The octree depth matches the point density of evenly spread points. Trimming removes surface that
    # only closes holes: surface is kept down to a density three levels below.
    depth = int(np.clip(np.ceil(0.5 * np.log2(sum(map(count_fused, fused)))), 6, 13))
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim = depth, float(depth - 3)
    options.num_threads = 1
    raw, joined = out.with_name(f".{out.name}"), out.with_name(f".points.{out.name}")
    try:
        if len(fused) > 1:
            _concatenate_fused(fused, joined)
        pycolmap.poisson_meshing(joined if len(fused) > 1 else fused[0], raw, options)
        mesh = read_mesh(raw)
    except (RuntimeError, ValueError) as error:
        raise ReconstructionError(f"no mesh: {' '.join(str(error).split())}") from error
    finally:
        raw.unlink(missing_ok=True)
        joined.unlink(missing_ok=True)
    write_ply_mesh(out, Mesh(mesh.vertices + origin, mesh.faces, unit=unit))
    return len(mesh)


def _concatenate_fused(paths: Sequence[Path], out: Path) -> None:
    """Write the points of several fused .ply files, whose headers differ in the number of points only, into one."""
    end = b"end_header\n"
    header = paths[0].read_bytes().split(end, 1)[0]
    count = sum(map(count_fused, paths))
    with out.open("wb") as file:
        file.write(re.sub(rb"element vertex \d+", b"element vertex %d" % count, header) + end)
        for path in paths:
            file.write(path.read_bytes().split(end, 1)[1])
