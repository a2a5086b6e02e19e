"""Inputs of a comparison in tiles: what their headers state, and the key of everything that results depend on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.extras import installed_versions
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import check_lengths, is_in_degrees
from pcbench.geometry.regions import Region
from pcbench.io import has_filters
from pcbench.io.contents import FileState, cloud_digest
from pcbench.io.files import file_in_setting
from pcbench.io.pieces import CloudOnDisk, open_cloud, read_piece
from pcbench.measure.settings import Settings
from pcbench.measure.tiled.alignment import known_pose
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.tasks.codec import fingerprint


def open_input(path: Path, settings: Settings, piece_points: int, *, skip_bad: bool) -> CloudOnDisk:
    """Describe a cloud; classes and returns select points where files have them, as in memory.

    Raises:
        InputError: a file or a setting is not usable, or the coordinates are degrees.
    """
    classes, returns = (settings.classes, settings.returns) if has_filters(path) else (None, None)
    cloud = open_cloud(path, classes=classes, returns=returns, piece_points=piece_points, skip_bad=skip_bad)
    if is_in_degrees(cloud.crs, cloud.unit):  # some points, because headers need not state a place
        points = read_piece(cloud, cloud.pieces[0]).points
        check_lengths(Cloud(points if len(points) else np.zeros((1, 3)), crs=cloud.crs, unit=cloud.unit), str(path))
    return cloud


def inputs_key(
    clouds: Mapping[str, CloudOnDisk],
    contents: Mapping[Path, FileState],
    settings: Settings,
    tiling: TilingSettings,
    maps: Path | None,
) -> str:
    """Return a text that identifies the inputs and everything that stored results depend on."""
    files = {
        name: [[str(file.path) for file in cloud.files], cloud_digest(cloud.path, contents)]
        for name, cloud in clouds.items()
    }
    how = tiling.tile_points, tiling.chosen_piece_points, tiling.max_distance
    pose, crop = known_pose(settings), file_in_setting(settings.crop)
    region = fingerprint(_plain_region(settings.crop) if crop is None else crop.read_bytes())
    read = None if pose is None else pose.matrix.tolist(), region
    found = [installed_versions(("pcbench",)), files, settings.plain(), how, read, maps]
    return hashlib.sha256(json.dumps(found, default=str).encode()).hexdigest()


def _plain_region(region: str | Region) -> Any:
    """Return a region for its fingerprint; of a class that is no data class, its attributes."""
    return region if isinstance(region, str) or is_dataclass(region) else [region.text, vars(region)]
