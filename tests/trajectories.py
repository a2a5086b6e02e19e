"""Trajectories and scenes of Tanks and Temples for tests."""

import json

import numpy as np
import shapes

from pcbench import Similarity, write_cloud
from pcbench.geometry.transform import format_matrix

SCAN_FROM_SFM = Similarity(shapes.rotation([1, 2, -1], 50.0), np.array([3.0, 1.0, -2.0]), 0.6)
SCAN_FROM_CANDIDATE = Similarity(shapes.rotation([0, 1, 3], -70.0), np.array([-4.0, 2.0, 5.0]), 2.5)


def log_text(centers, missing=(), first=0):
    """Return the text of a `.log` file with cameras at centres (N, 3); those in `missing` have no pose."""
    rng, lines = np.random.default_rng(0), []
    for place, center in enumerate(centers):
        pose, has_pose = np.eye(4), place not in missing
        if has_pose:
            pose[:3, :3] = shapes.rotation(rng.normal(size=3), rng.uniform(0, 180))
            pose[:3, 3] = center
        lines.append(f"{first + place} {first + place if has_pose else -1} 0")
        lines += [" ".join(map(repr, row)) for row in pose.tolist()]
    return "\n".join(lines) + "\n"


def circle(count=40):
    """Return camera centres (N, 3) around the terrain of `shapes`, in its coordinates."""
    turn = np.linspace(0, 6, count)
    return np.stack([20 + 25 * np.cos(turn), 20 + 25 * np.sin(turn), 8 + 3 * np.sin(3 * turn)], axis=1)


def scene_folder(folder, name, scan, centers, volume):
    """Write the files of a scene: its scan (N, 3), camera centres in its coordinates, and a box (6,) as its volume."""
    folder.mkdir(parents=True)
    write_cloud(folder / f"{name}.ply", scan)
    (folder / f"{name}_trans.txt").write_text(format_matrix(SCAN_FROM_SFM))
    (folder / f"{name}_COLMAP_SfM.log").write_text(log_text(SCAN_FROM_SFM.inverse().apply(centers)))
    x0, y0, z0, x1, y1, z1 = volume
    crop = {
        "class_name": "SelectionPolygonVolume",
        "orthogonal_axis": "Z",
        "axis_min": z0,
        "axis_max": z1,
        "bounding_polygon": [[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]],
    }
    (folder / f"{name}.json").write_text(json.dumps(crop))
    return folder
