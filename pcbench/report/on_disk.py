"""Comparison of clouds on disk: whether a comparison fits into memory, and how it is computed in tiles if it does not.

The headers of the files are read here, and the digests of their content. `pcbench.measure.tiled` computes.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import pcbench
from pcbench.errors import InputError, MissingExtra
from pcbench.io import has_filters
from pcbench.io.contents import FileState, cloud_contents, cloud_digest, digest
from pcbench.io.files import file_in_setting
from pcbench.io.meshes import holds_mesh
from pcbench.io.pieces import CloudOnDisk, is_in_pieces, open_cloud
from pcbench.measure.settings import Settings
from pcbench.measure.tiled.nearby import MAX_NEAR_POINTS
from pcbench.measure.tiled.settings import TILED_PRESETS, TilingSettings
from pcbench.measure.tiled.windows import MAX_SAMPLE
from pcbench.report.inputs import InputFile
from pcbench.report.recorded import record, record_tiling
from pcbench.report.words import memory_text

# Measured peaks of `pcbench compare`: 1 and 3 million points per cloud, and three candidates instead of one.
_BASE_BYTES = 100_000_000
_BYTES_PER_POINT = 240  # of the reference and of the largest candidate
_BYTES_PER_FURTHER_POINT = 95  # of the other candidates
_POINT_BYTES = 24  # x, y and z, which the figures above contain
_MIN_FILE_BYTES_PER_POINT = 1.0  # no format stores a point in less

When = Literal["always", "auto", "if-possible"]


@dataclass(frozen=True)
class TilingChoice:
    """How a comparison is computed in tiles, and when.

    Attributes:
        settings: settings of a tiled comparison.
        when: `always`; `auto`: if the clouds do not fit into the memory; `if-possible`: likewise, but in memory if
            tiles do not support a setting.
        workspace: folder for intermediate files; None: a hidden one, see `pcbench.report.workspace`.
    """

    settings: TilingSettings = field(default_factory=TilingSettings)
    when: When = "always"
    workspace: Path | None = None


@dataclass(frozen=True)
class CloudsOnDisk:
    """The clouds of a comparison, as the headers of their files describe them."""

    reference: CloudOnDisk
    candidates: Mapping[str, CloudOnDisk]

    @classmethod
    def open(
        cls, reference: Path, candidates: Mapping[str, Path], settings: Settings, tiling: TilingSettings
    ) -> CloudsOnDisk:
        """Read the headers, in pieces as a tiled comparison; raises the errors of `pcbench.io.pieces.open_cloud`."""
        first, *others = (
            open_cloud(
                path,
                **filters_for(path, settings),
                piece_points=tiling.chosen_piece_points,
                skip_bad=tiling.skip_bad,
            )
            for path in (reference, *candidates.values())
        )
        return cls(first, dict(zip(candidates, others, strict=True)))

    @property
    def memory(self) -> int:
        """Estimated bytes of memory that a comparison in memory needs."""
        largest, *others = sorted((cloud.count for cloud in self.candidates.values()), reverse=True)
        attributes = sum(
            max(cloud.nbytes_in_memory - _POINT_BYTES * cloud.count, 0)
            for cloud in (self.reference, *self.candidates.values())
        )
        points = _BYTES_PER_POINT * (self.reference.count + largest) + _BYTES_PER_FURTHER_POINT * sum(others)
        return _BASE_BYTES + points + attributes

    @cached_property
    def contents(self) -> dict[Path, FileState]:
        """State of each file of the clouds; all their bytes are read once.

        Raises:
            OSError: a file cannot be read.
        """
        return cloud_contents(cloud.path for cloud in (self.reference, *self.candidates.values()))

    def least_memory(self, tiling: TilingSettings, *, draws: bool = False) -> int:
        """Estimated bytes of memory that all processes of a tiled comparison need at least."""
        largest = max(cloud.count for cloud in self.candidates.values())
        # A dense candidate has up to twice as many points in the windows of its sample.
        windows = min(self.reference.count, MAX_SAMPLE) + min(largest, 2 * MAX_SAMPLE)
        # Later, the surroundings of queries are in memory.
        samples = max(windows, min(max(largest, self.reference.count), MAX_NEAR_POINTS))
        pieces = [piece.count for cloud in (self.reference, *self.candidates.values()) for piece in cloud.pieces]
        return tiling.least_memory(samples, max(pieces), draws=draws)

    def input_files(self) -> tuple[InputFile, dict[str, InputFile]]:
        """Return the records of the reference and of the candidates."""
        return self._input_file(self.reference), {n: self._input_file(cloud) for n, cloud in self.candidates.items()}

    def _input_file(self, cloud: CloudOnDisk) -> InputFile:
        return InputFile(str(cloud.path), cloud_digest(cloud.path, self.contents), cloud.warnings)

    def key(self, settings: Settings, tiling: TilingSettings) -> str:
        """Return a text that identifies the content of all files, and all settings that change results or tiles."""
        reference, candidates = self.input_files()
        clouds = {
            name: (str(Path(file.path).absolute()), file.sha256) for name, file in {"": reference, **candidates}.items()
        }
        named = [digest(path) for path in map(file_in_setting, (settings.register, settings.crop)) if path is not None]
        size = tiling.memory, tiling.workers  # they determine the size of tiles
        how = record_tiling(replace(tiling, skip_bad=False))  # a run that met a damaged file continues without it
        parts = [pcbench.__version__, record(settings), how, size, clouds, named]
        return hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()


def filters_for(path: Path, settings: Settings) -> dict[str, Any]:
    """Return the filters that apply to a path: candidates may have other formats than a filtered LAS reference."""
    if has_filters(path):
        return {"classes": settings.classes, "returns": settings.returns}
    return {}


def choose_tiles(
    reference: Path,
    candidates: Mapping[str, Path],
    settings: Settings,
    choice: TilingChoice,
    on_notice: Callable[[str], None],
    *,
    draws: bool = False,
) -> CloudsOnDisk | None:
    """Return the clouds on disk if the comparison is computed in tiles; None if it is computed in memory.

    Args:
        reference: path of the reference.
        candidates: paths of the candidates by name.
        settings: settings of the comparison.
        choice: when tiles are used.
        on_notice: called with one line that says why the size of the clouds decides.
        draws: whether pictures are drawn afterwards, which need memory too.

    Raises:
        InputError: tiles are used and do not support a setting or a file, or a file is damaged.
        MissingExtra: a format needs an optional library.
    """
    unsupported = unsupported_setting(reference, candidates, settings)
    paths = [reference, *candidates.values()]
    if choice.when == "always":
        if unsupported:
            raise InputError(
                f"a comparison in tiles does not support {unsupported} in this version: omit --tiles to compare in"
                " memory"
            )
        clouds = CloudsOnDisk.open(reference, candidates, settings, choice.settings)
        _warn_of_memory(clouds, choice.settings, on_notice, draws=draws)
        return clouds
    if _fits_surely(paths, choice.settings.memory) or _mesh(reference, candidates, settings):
        return None
    try:
        clouds = CloudsOnDisk.open(reference, candidates, settings, choice.settings)
    except (InputError, MissingExtra, OSError):
        return None  # the reader in memory gives the same error, or reads what has no pieces
    if clouds.memory <= choice.settings.memory:
        return None
    needed = (
        f"these clouds need about {memory_text(clouds.memory)} in memory, more than --memory"
        f" {memory_text(choice.settings.memory)}"
    )
    if not unsupported:
        on_notice(f"{needed}: computing in tiles")
        _warn_of_memory(clouds, choice.settings, on_notice, draws=draws)
        return clouds
    if choice.when == "auto":
        raise InputError(
            f"{needed}, and tiles do not support {unsupported} in this version: raise --memory, or omit it"
        )
    on_notice(f"{needed}, and tiles do not support {unsupported} in this version: computing in memory nevertheless")
    return None


def _warn_of_memory(
    clouds: CloudsOnDisk, tiling: TilingSettings, on_notice: Callable[[str], None], *, draws: bool
) -> None:
    """Say how much memory a comparison in tiles needs, if this is more than it may use."""
    least = clouds.least_memory(tiling, draws=draws)
    if least > tiling.memory:
        megabytes = -(-least // 1_000_000)
        on_notice(
            f"tiles of these clouds need about {megabytes} MB, more than --memory {memory_text(tiling.memory)}:"
            f" use --memory {megabytes}MB" + (" or fewer --workers" if (tiling.workers or 1) > 1 else "")
        )


def unsupported_setting(reference: Path, candidates: Mapping[str, Path], settings: Settings) -> str | None:
    """Return a setting that a tiled comparison does not support, as words; None if it supports all."""
    if settings.maps:
        return f"the map {settings.maps[0]} (--map)"
    if others := [name for name in settings.presets if name not in (*TILED_PRESETS, "mpeg")]:  # all settings have mpeg
        return f"the preset {others[0]} (--preset)"
    if settings.tolerance is not None:
        return "--tolerance"
    if settings.min_opacity is not None or settings.max_axis is not None:
        return "filters of Gaussian splats (--min-opacity, --max-axis)"
    return _mesh(reference, candidates, settings)


def _mesh(reference: Path, candidates: Mapping[str, Path], settings: Settings) -> str | None:
    """Return which input is sampled as a mesh, as words; None if none is."""
    if reference.is_file() and holds_mesh(reference):
        return "a mesh as the reference"
    if not settings.vertices and any(path.is_file() and holds_mesh(path) for path in candidates.values()):
        return "a mesh as a candidate (sample points on it with pcbench convert MESH CLOUD.ply --sample N)"
    return None


def link_maps(maps: Path, folder: Path) -> bool:
    """Put the map files of a workspace into a report folder, and return whether there are any.

    They are linked where the file system allows it, and copied elsewhere, so that the workspace stays complete until
    the report is.
    """
    if not maps.is_dir() or not any(maps.iterdir()):
        return False
    shutil.copytree(maps, folder, copy_function=_link)
    return True


def _link(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
    return target


def _fits_surely(paths: list[Path], memory: int) -> bool:
    """Return whether the sizes of the files alone show that they fit, without a look at their headers."""
    try:
        sizes = [path.stat().st_size for path in paths if path.is_file() and not is_in_pieces(path)]
    except OSError:
        return True  # the reader in memory gives the error
    points = sum(sizes) / _MIN_FILE_BYTES_PER_POINT
    return len(sizes) == len(paths) and _BASE_BYTES + _BYTES_PER_POINT * points <= memory
