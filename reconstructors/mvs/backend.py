"""Choice of the matcher: COLMAP's on a GPU, or the bundled one on any CPU."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from pcbench.children import run_module
from pcbench.errors import InputError, ReconstructionError
from pcbench.plugins.progress import progress
from pcbench.plugins.stages import stage
from reconstructors.mvs.bundled import GEOMETRIC_FOLDER, Matching, stage_digest
from reconstructors.mvs.fusion import Track, short_names, write_workspace
from reconstructors.mvs.maps import DepthMap, read_raster, write_map
from reconstructors.mvs.sources import MatchedImage
from reconstructors.mvs.sparse import SparseModel
from reconstructors.mvs.views import IMAGE, stage_location

Backend = Literal["auto", "colmap", "bundled"]

_CHILD_MODULE = "reconstructors.mvs.colmap_child"
_KEY_FILE = "inputs.json"


def choose_backend(requested: Backend) -> tuple[Literal["colmap", "bundled"], str]:
    """Return the backend to use, and the reason.

    Raises:
        InputError: COLMAP's was requested and cannot run.
    """
    if requested == "bundled":
        return "bundled", "as requested"
    problem = colmap_problem()
    if problem is None:
        return "colmap", "a GPU and a pycolmap with CUDA are available"
    if requested == "colmap":
        raise InputError(f"backend=colmap cannot run here: {problem}; backend=bundled runs on any CPU")
    return "bundled", problem


def colmap_problem() -> str | None:
    """Return why COLMAP's dense stereo cannot run here, None if it can.

    A child process finds out, because a pycolmap with CUDA crashes on a machine without a GPU.
    """
    ended = run_module(_CHILD_MODULE, "probe")
    if ended.code == 0:
        return None
    return ended.last_error_line or f"pycolmap ended its process with exit code {ended.code}"


def compute_colmap_maps(
    matching: Matching, references: Sequence[MatchedImage], sparse: SparseModel, workspace: Path
) -> dict[str, Path]:
    """Compute depth maps with COLMAP's dense stereo; return the stages by image name.

    COLMAP's own files stay as it writes them: those that are complete are used again.

    Args:
        matching: the photographs and the plan.
        references: images to match, with their sources.
        sparse: cameras and sparse points.
        workspace: the reconstructor's folder.

    Raises:
        ReconstructionError: COLMAP failed, or wrote no map.
    """
    folder = workspace / "colmap"
    key = json.dumps(
        {
            "views": {name: stage_digest(path) for name, path in matching.views.items()},
            "poses": {n: c.cam_from_world.matrix.tolist() for n, c in matching.photographs.cameras.items()},
            "sources": [[r.name, *r.sources] for r in references],
            "plan": repr(matching.plan),
            "seed": matching.seed,
        }
    )
    if not (folder / _KEY_FILE).is_file() or (folder / _KEY_FILE).read_text() != key:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        _prepare_workspace(folder, matching, references, sparse)
        (folder / _KEY_FILE).write_text(key)
    _remove_truncated(folder / "stereo")
    progress(f"COLMAP's dense stereo of {len(references)} images")
    ended = run_module(
        _CHILD_MODULE,
        "match",
        str(folder.absolute()),
        str(matching.plan.photometric_iterations + matching.plan.geometric_iterations),
    )
    if ended.code != 0:
        raise ReconstructionError(f"COLMAP's dense stereo failed: {ended.last_error_line or f'exit code {ended.code}'}")

    short = dict(zip(matching.photographs.cameras, short_names(matching.photographs.cameras), strict=True))
    stages = {}
    for reference in references:
        depth = folder / f"stereo/depth_maps/{short[reference.name]}.geometric.bin"
        normal = folder / f"stereo/normal_maps/{short[reference.name]}.geometric.bin"
        if depth.is_file() and normal.is_file():
            stages[reference.name] = _store_map(reference.name, depth, normal, key, workspace)
    if not stages:
        raise ReconstructionError("COLMAP's dense stereo reported no error but wrote no depth map")
    return stages


def _prepare_workspace(
    folder: Path, matching: Matching, references: Sequence[MatchedImage], sparse: SparseModel
) -> None:
    cameras = matching.photographs.cameras
    images = {name: matching.views[name] / IMAGE for name in cameras}
    rows = sparse.visibility.tocsr()
    columns = [sparse.names.index(name) for name in cameras]
    visibility = rows[:, columns].tocsr()
    tracks = []
    for k, point in enumerate(sparse.points):
        observers = np.sort(visibility.indices[visibility.indptr[k] : visibility.indptr[k + 1]]).astype(np.int64)
        if len(observers) > 1:
            tracks.append(Track(point, observers + 1))
    write_workspace(folder, cameras, images, tracks)
    short = dict(zip(cameras, short_names(cameras), strict=True))
    lines = [f"{short[r.name]}\n{', '.join(short[source] for source in r.sources)}\n" for r in references]
    (folder / "stereo/patch-match.cfg").write_text("".join(lines))


def _store_map(name: str, depth: Path, normal: Path, key: str, workspace: Path) -> Path:
    """Store a map of COLMAP's as a stage, with confidence 1 for each depth that COLMAP kept."""

    def make(folder: Path) -> None:
        z = read_raster(depth)
        write_map(folder, DepthMap(np.maximum(z, 0), read_raster(normal), (z > 0).astype(np.float32)))

    return stage(*stage_location(workspace / GEOMETRIC_FOLDER, name), {"colmap": key}, make)


def _remove_truncated(folder: Path) -> None:
    """Remove files that a killed run left incomplete, because COLMAP checks only that a file exists."""
    for path in (*folder.glob("depth_maps/*.bin"), *folder.glob("normal_maps/*.bin")):
        try:
            read_raster(path)
        except InputError:
            path.unlink()
