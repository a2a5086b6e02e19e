"""Run a reconstructor in a child process; every outcome, including a crash, becomes a recorded result."""

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
from pcbench.io.contents import digest
from pcbench.native import _core
from pcbench.plugins import Reconstruction
from pcbench.plugins.progress import follow_log
from pcbench.registration import SurveyResiduals
from pcbench.regular_files import read_json
from pcbench.scratch import atomic_write, lock_output, scratch_folder
from pcbench.systems import SIGKILL, file_size_limit, signal_name

Status = Literal["ok", "failed", "crashed", "timeout", "garbage", "refused"]

# Names in the workspace. The plugin has its own folder there, which is kept between runs.
JOB, OUTCOME, LOG, CLOUD, CAMERAS, PLUGIN = "job.json", "outcome.json", "log.txt", "cloud.ply", "cameras", "plugin"
_OUTPUT_DIGEST_FILE = "made.txt"  # digest of the file to which the cloud was written

# The number of threads and the processor's kernels change the rounding of BLAS products, which changed results of
# COLMAP's global mapping in tests. One thread and the kernels that all AVX2 processors have give the same bits.
_REPRODUCIBLE_BLAS = {"OPENBLAS_NUM_THREADS": "1"} | (
    {} if _core.isa() == "baseline" else {"OPENBLAS_CORETYPE": "Haswell"}
)

_MAX_TAIL_BYTES = 4000  # end of a log that is searched for its last line


@dataclass(frozen=True)
class ReconstructionJob:
    """A reconstructor with its settings as text, and its scene: arguments of `read_scene` and selected images.

    Args:
        plugin: spec of the reconstructor, see `find_plugin`.
        scene: folder of the scene.
        settings: settings as text.
        cameras: "auto", "none" or a path, as for `read_scene`.
        masks: folder of the masks.
        image_scale: scale of the working size, as for `read_scene`.
        images: names of the images to use; None for all.
    """

    plugin: str
    scene: Path
    settings: Mapping[str, str] = field(default_factory=dict)
    cameras: str = "auto"
    masks: Path | None = None
    image_scale: float = 1.0
    images: tuple[str, ...] | None = None

    def to_json(self) -> str:
        """Return the job as JSON, with absolute paths, because the child runs in another folder."""
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
    """Outcome of a reconstruction.

    Args:
        status: "ok", "failed" (the plugin reported why it cannot), "crashed", "timeout", "garbage" (the returned value
            is not a reconstruction), or "refused" (the plugin, its settings or the scene are invalid).
        message: one line that explains the status; empty for "ok".
        wall_s: wall time of the process and its children in seconds.
        cpu_s: CPU time of the process and its children in seconds.
        peak_rss_bytes: peak memory; None if the process ended before it could report it.
        gpu_bytes: peak memory of torch on CUDA devices; None if torch used none, or if it was not reported.
        log: file with the output of the process.
        settings: all settings of the reconstructor as text, including defaults; empty if it was refused.
        warnings: warnings about the scene, such as parts that were left out.
        reconstruction: the result; None unless the status is "ok".
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

    def require_reconstruction(self) -> Reconstruction:
        """Return the reconstruction.

        Raises:
            InputError: the run was refused.
            ReconstructionError: the run ended without a reconstruction.
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
        job: the reconstructor and its scene.
        workspace: folder, created if missing. A later run of the same reconstructor resumes from its finished steps.
            Simultaneous runs need different workspaces.
        time_limit_s: seconds after which the process and its children are killed.
        on_progress: called from another thread with each progress report (`pcbench.plugins.progress`).

    Raises:
        InputError: another run uses the workspace.
        OSError: the workspace cannot be written.
    """
    (workspace / PLUGIN).mkdir(parents=True, exist_ok=True)
    with lock_output(workspace):
        return _run(job, workspace, time_limit_s, on_progress)


def _run(
    job: ReconstructionJob, workspace: Path, time_limit_s: float | None, on_progress: Callable[[str], None] | None
) -> Run:
    (workspace / OUTCOME).unlink(missing_ok=True)
    with atomic_write(workspace / JOB) as file:
        file.write(job.to_json().encode())
    start = time.perf_counter()
    with (workspace / LOG).open("wb", buffering=0) as log, follow_log(workspace / LOG, on_progress):
        ended = run_module(
            "pcbench.plugins.reconstruct_child",
            str(workspace.absolute()),
            limits=Limits(seconds=time_limit_s),
            environment={name: os.environ.get(name, value) for name, value in _REPRODUCIBLE_BLAS.items()},
            log=log,
        )
    wall_s = time.perf_counter() - start
    try:
        outcome = _read_outcome(workspace)
    except (OSError, ValueError):  # missing, or overwritten by the plugin
        outcome = {"status": "crashed", "message": _describe_exit(ended.code, workspace / LOG)}
    if outcome["status"] == "crashed" and (limit := file_size_limit()) is not None:  # libraries do not name it
        outcome["message"] = outcome["message"].rstrip(".") + (
            f"; files are limited to {limit / 1024:,.0f} KiB (ulimit -f), which may be the cause: allow more with"
            " ulimit -f unlimited"
        )
    if ended.timed_out:
        outcome |= {"status": "timeout", "message": f"it exceeded the time limit of {time_limit_s:g} s"}
    reconstruction = None
    if outcome["status"] == "ok":
        try:
            reconstruction = read_reconstruction(workspace)
        except (PcbenchError, OSError, ValueError) as error:  # the result is unreadable
            outcome |= {"status": "garbage", "message": str(error)}
    status: Status = outcome["status"]
    message = "".join(c if c.isprintable() else "?" for c in outcome.get("message", ""))  # no terminal control codes
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
        reconstruction=reconstruction,
    )


def check_workspace(folder: Path) -> None:
    """Refuse a folder that cannot be a workspace, before `run`.

    Raises:
        InputError: it is no folder, or has files that no reconstruction wrote.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder for the workspace, got a file: choose another name")
    ours = (folder / JOB).is_file() and (folder / PLUGIN).is_dir()
    if folder.is_dir() and any(folder.iterdir()) and not ours:
        raise InputError(f"{folder}: expected an empty folder or an earlier workspace: choose another, or empty it")


def record_output(workspace: Path, out: Path) -> None:
    """Record in a workspace the digest of the file to which its cloud was written, for `is_recorded_output`."""
    with atomic_write(workspace / _OUTPUT_DIGEST_FILE) as file:
        file.write(digest(out).encode())


def is_recorded_output(workspace: Path, out: Path) -> bool:
    """Return whether a file is the unchanged output of an earlier run in the workspace, which may be replaced."""
    try:
        return (workspace / _OUTPUT_DIGEST_FILE).read_text(encoding="utf-8") == digest(out)
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


def _describe_exit(code: int, log: Path) -> str:
    try:
        with log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _MAX_TAIL_BYTES))
            text = file.read().decode(errors="replace")
    except OSError as error:
        return f"the process ended with exit code {code}, and its log cannot be read: {error.strerror}"
    last = last_line(text) or "it printed nothing"
    if code < 0:
        hint = ", perhaps because memory ran out" if code == -SIGKILL else ""
        return f"the process was ended by {signal_name(-code)}{hint}; its last line: {last[:200]}"
    return f"the process ended with exit code {code} and without a result; its last line: {last[:200]}"


def read_reconstruction(workspace: Path) -> Reconstruction:
    """Read the reconstruction of the last successful run in a workspace.

    Raises:
        InputError, OSError, ValueError: its files are missing or damaged.
    """
    outcome = _read_outcome(workspace)
    cameras = read_colmap_cameras(workspace / CAMERAS) if outcome["cameras"] else ()
    cloud = read_cloud(workspace / CLOUD)
    try:
        residuals = SurveyResiduals.from_plain(outcome["survey"]) if "survey" in outcome else SurveyResiduals()
    except (KeyError, TypeError) as error:
        raise ValueError(f"{workspace / OUTCOME}: the residuals of surveyed points are damaged: {error}") from error
    by_name = {camera.name: camera for camera in cameras}
    return Reconstruction(cloud, outcome["gauge"], by_name, tuple(outcome["notes"]), residuals, outcome.get("origin"))


@dataclass(frozen=True)
class Description:
    """Description of a reconstructor that has not run.

    Args:
        settings: names of its settings.
        origin: its package with version, or its file.
        sha256: digest of its code, sources and compiled modules (`pcbench.plugins.code.plugin_files`); None if it could
            not be imported.
        problem: why it cannot be described, such as a failed import; None if it can.
        help: first paragraph of its docstring.
        more: rest of its docstring.
        missing: why it cannot run here, as it reports.
        types: types of its settings as text.
        defaults: defaults of its settings as text; None for required settings.
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
    """Describe a reconstructor. A child process with a time limit imports it, because importing may do anything.

    Args:
        plugin: a spec as for `pcbench.plugins.find_plugin`.
        time_limit_s: seconds after which the child process is ended.
    """
    with scratch_folder() as folder:
        file = folder / "description.json"
        limits = Limits(seconds=time_limit_s)
        ended = run_module("pcbench.plugins.describe_child", plugin, str(file), limits=limits)
        if ended.timed_out:
            return Description(problem=f"importing it took longer than {time_limit_s:g} s")
        try:
            outcome: dict[str, Any] = read_json(file)
            values: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in outcome.items()}
            return Description(**values)
        except (OSError, InputError, AttributeError, TypeError):  # missing, or overwritten during its import
            return Description(problem="its import ended the process")


def absolute(plugin: str) -> str:
    """Return a spec with an absolute path, valid from any folder."""
    file, colon, name = plugin.rpartition(":")
    return f"{Path(file).absolute()}:{name}" if colon and file.endswith(".py") else plugin
