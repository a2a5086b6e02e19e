"""Runs a reconstructor in a process of its own: whatever it does there, it ends as a recorded result."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from pcbench.children import Limits, last_line, run_module
from pcbench.errors import InputError, PcbenchError, ReconstructionError
from pcbench.io import read_cloud
from pcbench.io.colmap_model import read_colmap_cameras
from pcbench.io.files import atomic_write, digest, read_json
from pcbench.native import _core
from pcbench.plugins import Reconstruction
from pcbench.plugins.progress import followed
from pcbench.registration import SurveyResiduals
from pcbench.scratch import claim, scratch_folder
from pcbench.systems import SIGKILL, signal_name

Status = Literal["ok", "failed", "crashed", "timeout", "garbage", "refused"]

# In the workspace. The plugin has a folder of its own in it, which is kept between runs.
JOB, OUTCOME, LOG, CLOUD, CAMERAS, PLUGIN = "job.json", "outcome.json", "log.txt", "cloud.ply", "cameras", "plugin"
_MADE = "made.txt"  # the digest of the file that the cloud was written to

# How BLAS divides a product among threads, and its kernels for a processor, decide last bits: those of COLMAP's global
# mapping were seen to differ. One thread, and the kernels that every processor with AVX2 has, give the same ones.
_SAME_BITS = {"OPENBLAS_NUM_THREADS": "1"} | ({} if _core.isa() == "baseline" else {"OPENBLAS_CORETYPE": "Haswell"})

_MAX_TAIL = 4000  # bytes of a log that its last line is looked for in


@dataclass(frozen=True)
class ReconstructionJob:
    """A reconstructor, its settings as text, and the scene it gets: the arguments of `read_scene`, and which images of
    it (None: all).
    """

    plugin: str
    scene: Path
    settings: Mapping[str, str] = field(default_factory=dict)
    cameras: str = "auto"
    masks: Path | None = None
    image_scale: float = 1.0
    images: tuple[str, ...] | None = None

    def to_json(self) -> str:
        # The process runs elsewhere: every path is made absolute.
        cameras = self.cameras if self.cameras in ("auto", "none") else str(Path(self.cameras).absolute())
        values = {
            "plugin": absolute(self.plugin),
            "settings": dict(self.settings),
            "scene": str(self.scene.absolute()),
            "cameras": cameras,
            "masks": None if self.masks is None else str(self.masks.absolute()),
            "image_scale": self.image_scale,
            "images": None if self.images is None else list(self.images),
        }
        return json.dumps(values, indent=1) + "\n"


@dataclass(frozen=True, eq=False)
class Run:
    """How a reconstruction went.

    Args:
        status: "ok"; "failed" (the plugin said why it cannot), "crashed", "timeout", "garbage" (what it returned is no
            reconstruction), "refused" (the plugin, its settings or the scene are not as they have to be).
        message: one line for every status but "ok".
        wall_s, cpu_s: seconds of the process and its children, from its start to its end.
        peak_rss_bytes: the most memory it had at a time; None where it did not live to say so.
        gpu_bytes: the most memory that torch held on CUDA devices; None where it used none, or did not live to say so.
        log: what it printed.
        settings: all of the reconstructor's settings as text, defaults included; empty if it was refused.
        warnings: what was left out of the scene.
    """

    status: Status
    message: str
    wall_s: float
    cpu_s: float
    peak_rss_bytes: int | None
    gpu_bytes: int | None
    log: Path
    settings: Mapping[str, str]
    warnings: tuple[str, ...]
    reconstruction: Reconstruction | None

    def required(self) -> Reconstruction:
        """The reconstruction.

        Raises:
            InputError: it was refused.
            ReconstructionError: there is none for another reason.
        """
        if self.reconstruction is not None:
            return self.reconstruction
        if self.status == "refused":
            raise InputError(self.message)
        raise ReconstructionError(f"{self.status}: {self.message} (log: {self.log})")


def run(
    job: ReconstructionJob,
    workspace: Path,
    time_limit_s: float | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> Run:
    """Run a reconstructor. Its failure is a result, not an exception.

    Args:
        workspace: a folder that is made if it is missing; a later run of the same reconstructor goes on from what this
            one has finished. Two runs at a time need two.
        time_limit_s: after it the process and its children are killed.
        on_progress: called with what the reconstructor says of how far it is (`pcbench.plugins.progress`), by another
            thread.

    Raises:
        InputError: another run is at work in the workspace.
        OSError: the workspace cannot be written.
    """
    (workspace / PLUGIN).mkdir(parents=True, exist_ok=True)
    with claim(workspace):
        return _run(job, workspace, time_limit_s, on_progress)


def _run(
    job: ReconstructionJob, workspace: Path, time_limit_s: float | None, on_progress: Callable[[str], None] | None
) -> Run:
    (workspace / OUTCOME).unlink(missing_ok=True)
    with atomic_write(workspace / JOB) as file:
        file.write(job.to_json().encode())
    start = time.perf_counter()
    with (workspace / LOG).open("wb", buffering=0) as log, followed(workspace / LOG, on_progress):
        ended = run_module(
            "pcbench.plugins.reconstruct_child",
            str(workspace.absolute()),
            limits=Limits(seconds=time_limit_s),
            environment={name: os.environ.get(name, value) for name, value in _SAME_BITS.items()},
            log=log,
        )
    wall_s = time.perf_counter() - start
    try:
        outcome = _read_outcome(workspace)
    except (OSError, ValueError):  # none, or what the plugin left in its place
        outcome = {"status": "crashed", "message": _how_it_ended(ended.code, workspace / LOG)}
    if ended.timed_out:
        outcome |= {"status": "timeout", "message": f"it took longer than the limit of {time_limit_s:g} s"}
    made = None
    if outcome["status"] == "ok":
        try:
            made = read_reconstruction(workspace)
        except (PcbenchError, OSError, ValueError) as error:  # written, but nothing that can be read
            outcome |= {"status": "garbage", "message": str(error)}
    status: Status = outcome["status"]
    message = "".join(c if c.isprintable() else "?" for c in outcome.get("message", ""))  # no plugin paints terminals
    return Run(
        status=status,
        message=message,
        wall_s=wall_s,
        cpu_s=ended.cpu_s,
        peak_rss_bytes=outcome.get("peak_rss_bytes"),
        gpu_bytes=outcome.get("gpu_bytes"),
        log=workspace / LOG,
        settings=outcome.get("settings", {}),
        warnings=tuple(outcome.get("warnings", ())),
        reconstruction=made,
    )


def check_workspace(folder: Path) -> None:
    """Say before `run` that a folder is no place to run in.

    Raises:
        InputError: it holds something, and no reconstruction ran there: what one leaves may be replaced.
    """
    ours = (folder / JOB).is_file() and (folder / PLUGIN).is_dir()
    if folder.is_dir() and any(folder.iterdir()) and not ours:
        raise InputError(f"{folder}: the workspace is not empty and no reconstruction's: choose another, or empty it")


def note_made(workspace: Path, out: Path) -> None:
    """Keep in a workspace what its cloud was written to, so that `was_made` knows it again."""
    with atomic_write(workspace / _MADE) as file:
        file.write(digest(out).encode())


def was_made(workspace: Path, out: Path) -> bool:
    """Whether a file is what an earlier run in the workspace wrote, unchanged: it may be replaced."""
    try:
        return (workspace / _MADE).read_text(encoding="utf-8") == digest(out)
    except (OSError, ValueError):
        return False


def _read_outcome(workspace: Path) -> dict[str, Any]:
    outcome = read_json(workspace / OUTCOME)
    expected = {"status", "cameras", "gauge", "notes"}
    if not isinstance(outcome, dict) or outcome.get("status") not in get_args(Status):
        raise ValueError(f"{workspace / OUTCOME}: expected the outcome of a run")
    if outcome["status"] == "ok" and not expected <= outcome.keys():
        raise ValueError(f"{workspace / OUTCOME}: expected {', '.join(sorted(expected))}")
    return outcome


def _how_it_ended(code: int, log: Path) -> str:
    try:
        with log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _MAX_TAIL))
            text = file.read().decode(errors="replace")
    except OSError as error:
        return f"the process ended with code {code} and without its log: {error.strerror}"
    last = last_line(text) or "it printed nothing"
    if code < 0:
        hint = ", perhaps for want of memory" if code == -SIGKILL else ""
        return f"the process was ended by {signal_name(-code)}{hint}; its last line: {last[:200]}"
    return f"the process ended with code {code} and without a result; its last line: {last[:200]}"


def read_reconstruction(workspace: Path) -> Reconstruction:
    """What the last run in a workspace made, if it went well.

    Raises:
        InputError, OSError, ValueError: its files are not there, or damaged.
    """
    outcome = _read_outcome(workspace)
    cameras = read_colmap_cameras(workspace / CAMERAS) if outcome["cameras"] else ()
    cloud = read_cloud(workspace / CLOUD)
    try:
        residuals = SurveyResiduals.from_plain(outcome["survey"]) if "survey" in outcome else SurveyResiduals()
    except (KeyError, TypeError) as error:
        raise ValueError(f"{workspace / OUTCOME}: the residuals of surveyed points are damaged: {error}") from error
    return Reconstruction(cloud, outcome["gauge"], {c.name: c for c in cameras}, tuple(outcome["notes"]), residuals)


@dataclass(frozen=True)
class Description:
    """What a reconstructor is, before it runs.

    Args:
        settings: the names of its settings.
        origin: its package with version, or its file.
        sha256: digest of its code, sources and compiled modules: of its package, or of its file and what lies beside
            it (`pcbench.plugins.code.plugin_files`); None where nothing is known of it.
        problem: why nothing is known of it; None where all is well.
        help, more: the first paragraph of its docstring, and the rest.
        missing: what keeps it from running here, by its own account.
        types, defaults: of its settings, as text; a default of None must be given.
    """

    settings: tuple[str, ...] = ()
    origin: str = ""
    sha256: str | None = None
    problem: str | None = None
    help: str = ""
    more: str = ""
    missing: str | None = None
    types: tuple[str, ...] = ()
    defaults: tuple[str | None, ...] = ()


def describe(plugin: str, time_limit_s: float = 60.0) -> Description:
    """Look at a reconstructor in a process of its own, which is ended after the limit: importing one can do anything.

    Args:
        plugin: a spec as `pcbench.plugins.find_plugin` takes it.
    """
    with scratch_folder() as folder:
        file = folder / "description.json"
        limits = Limits(seconds=time_limit_s)
        ended = run_module("pcbench.plugins.describe_child", plugin, str(file), limits=limits)
        if ended.timed_out:
            return Description(problem=f"importing it takes longer than {time_limit_s:g} s")
        try:
            outcome: dict[str, Any] = read_json(file)
            values: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in outcome.items()}
            return Description(**values)
        except (OSError, InputError, AttributeError, TypeError):  # none, or what its import left in its place
            return Description(problem="the process ends when it is imported")


def absolute(plugin: str) -> str:
    """A spec that means the same from any folder."""
    left, colon, name = plugin.rpartition(":")
    return f"{Path(left).absolute()}:{name}" if colon and left.endswith(".py") else plugin
