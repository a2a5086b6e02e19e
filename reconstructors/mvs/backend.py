"""Which matcher runs: COLMAP's on a GPU, or the bundled one on any CPU."""

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
from reconstructors.mvs.bundled import GEOMETRIC, Matching, digest_of
from reconstructors.mvs.fusion import Track, short_names, write_workspace
from reconstructors.mvs.maps import DepthMap, read_raster, write_map
from reconstructors.mvs.sources import MatchedImage
from reconstructors.mvs.sparse import Sparse
from reconstructors.mvs.views import IMAGE, in_folder

Backend = Literal["auto", "colmap", "bundled"]

_CHILD = "reconstructors.mvs.colmap_child"
_KEY = "inputs.json"


def choose_backend(asked: Backend) -> tuple[Literal["colmap", "bundled"], str]:
    """The backend that runs, and why.

    Raises:
        InputError: COLMAP's was asked for and cannot run.
    """
    if asked == "bundled":
        return "bundled", "asked for"
    lacking = why_no_colmap()
    if lacking is None:
        return "colmap", "there are a GPU and a pycolmap with CUDA"
    if asked == "colmap":
        raise InputError(f"backend=colmap cannot run here: {lacking}; backend=bundled runs on any CPU")
    return "bundled", lacking


def why_no_colmap() -> str | None:
    """What keeps COLMAP's dense stereo from running; asked in a child process, since a pycolmap with CUDA ends the
    process that it is in where there is no GPU.
    """
    ended = run_module(_CHILD, "probe")
    if ended.code == 0:
        return None
    return ended.last_words or f"pycolmap ended the process that asked it, with code {ended.code}"


def colmap_maps(
    matching: Matching, references: Sequence[MatchedImage], sparse: Sparse, workspace: Path
) -> dict[str, Path]:
    """The stages of COLMAP's maps by image name. Its own files are kept as it writes them: those that are complete are
    not made again.

    Raises:
        ReconstructionError: it broke down, or made no map.
    """
    folder = workspace / "colmap"
    key = json.dumps(
        {
            "views": {name: digest_of(path) for name, path in matching.views.items()},
            "poses": {n: c.cam_from_world.matrix.tolist() for n, c in matching.photographs.cameras.items()},
            "sources": [[r.name, *r.sources] for r in references],
            "plan": repr(matching.plan),
            "seed": matching.seed,
        }
    )
    if not (folder / _KEY).is_file() or (folder / _KEY).read_text() != key:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        _prepare(folder, matching, references, sparse)
        (folder / _KEY).write_text(key)
    _remove_truncated(folder / "stereo")
    progress(f"COLMAP's dense stereo of {len(references)} images")
    ended = run_module(_CHILD, "match", str(folder.absolute()), str(matching.plan.iterations + matching.plan.geometric))
    if ended.code != 0:
        raise ReconstructionError(f"COLMAP's dense stereo broke down: {ended.last_words or f'code {ended.code}'}")

    short = dict(zip(matching.photographs.cameras, short_names(matching.photographs.cameras), strict=True))
    made = {}
    for reference in references:
        depth = folder / f"stereo/depth_maps/{short[reference.name]}.geometric.bin"
        normal = folder / f"stereo/normal_maps/{short[reference.name]}.geometric.bin"
        if depth.is_file() and normal.is_file():
            made[reference.name] = _kept(reference.name, depth, normal, key, workspace)
    if not made:
        raise ReconstructionError("no map is made: COLMAP's dense stereo ended without an error and without maps")
    return made


def _prepare(folder: Path, matching: Matching, references: Sequence[MatchedImage], sparse: Sparse) -> None:
    cameras = matching.photographs.cameras
    images = {name: matching.views[name] / IMAGE for name in cameras}
    rows = sparse.shows.tocsr()
    columns = [sparse.names.index(name) for name in cameras]
    shows = rows[:, columns].tocsr()
    tracks = []
    for k, point in enumerate(sparse.points):
        seen = np.sort(shows.indices[shows.indptr[k] : shows.indptr[k + 1]]).astype(np.int64)
        if len(seen) > 1:
            tracks.append(Track(point, seen + 1))
    write_workspace(folder, cameras, images, tracks)
    short = dict(zip(cameras, short_names(cameras), strict=True))
    lines = [f"{short[r.name]}\n{', '.join(short[source] for source in r.sources)}\n" for r in references]
    (folder / "stereo/patch-match.cfg").write_text("".join(lines))


def _kept(name: str, depth: Path, normal: Path, key: str, workspace: Path) -> Path:
    """The stage with a map of COLMAP's, whose confidence is 1 where it kept a depth."""

    def make(folder: Path) -> None:
        z = read_raster(depth)
        write_map(folder, DepthMap(np.maximum(z, 0), read_raster(normal), (z > 0).astype(np.float32)))

    return stage(*in_folder(workspace / GEOMETRIC, name), {"colmap": key}, make)


def _remove_truncated(folder: Path) -> None:
    """What a killed run left half-written: COLMAP goes by the names of files alone."""
    for path in (*folder.glob("depth_maps/*.bin"), *folder.glob("normal_maps/*.bin")):
        try:
            read_raster(path)
        except InputError:
            path.unlink()
