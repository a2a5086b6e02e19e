"""Child process `reconstruct_child WORKSPACE`: run the job in a workspace.

It writes outcome.json and, after a success, cloud.ply and the cameras.
"""

from __future__ import annotations

import errno
import json
import shutil
import sys
import traceback
from dataclasses import fields
from pathlib import Path
from typing import Any

from pcbench.errors import InputError, MissingExtra, PcbenchError, reason_of
from pcbench.io import write_cloud
from pcbench.io.colmap_model import write_colmap_model
from pcbench.plugins import Plugin, Reconstruction, Reconstructor, find_plugin
from pcbench.plugins.code import register_plugin_code
from pcbench.plugins.run import CAMERAS, CLOUD, JOB, OUTCOME, PLUGIN
from pcbench.scenes import Scene, read_scene
from pcbench.scratch import atomic_write
from pcbench.systems import peak_memory_with_children


def main(workspace: Path) -> None:
    """Run the job of a workspace and write its outcome."""
    job = json.loads((workspace / JOB).read_text(encoding="utf-8"))
    warnings: list[str] = []
    outcome: dict[str, Any] = {"warnings": warnings}
    try:
        plugin, reconstructor, scene = _prepare(job, warnings)
    except PcbenchError as error:
        outcome |= {"status": "refused", "message": str(error)}
    else:
        outcome["settings"] = {f.name: str(getattr(reconstructor, f.name)) for f in fields(plugin.cls) if f.init}
        outcome |= _reconstruct(plugin, reconstructor, scene, workspace)
    outcome |= {"peak_rss_bytes": peak_memory_with_children(), "gpu_bytes": _peak_gpu_bytes()}
    with atomic_write(workspace / OUTCOME) as file:
        file.write(json.dumps(outcome, indent=1).encode() + b"\n")


def _prepare(job: dict[str, Any], warnings: list[str]) -> tuple[Plugin, Reconstructor, Scene]:
    plugin = find_plugin(job["plugin"])
    register_plugin_code(plugin.cls.__module__)
    reconstructor = plugin.configure(job["settings"])
    if missing := plugin.missing:
        raise InputError(f"{plugin.name} cannot run here: {missing}")
    scene = read_scene(
        job["scene"],
        cameras=job["cameras"],
        masks=job["masks"],
        image_scale=job["image_scale"],
        on_warning=warnings.append,
    )
    return plugin, reconstructor, scene if job["images"] is None else scene.select(job["images"])


def _reconstruct(plugin: Plugin, reconstructor: Reconstructor, scene: Scene, workspace: Path) -> dict[str, Any]:
    try:
        result: Any = reconstructor.reconstruct(scene, workspace / PLUGIN)
    except MissingExtra as error:  # as if the plugin had reported it as missing
        return {"status": "refused", "message": str(error)}
    except PcbenchError as error:
        traceback.print_exc()
        return {"status": "failed", "message": str(error)}
    except Exception as error:
        traceback.print_exc()
        reason = _disk_problem(error, workspace) or plugin.error_summary(error)
        return {"status": "crashed", "message": reason}
    if not isinstance(result, Reconstruction):
        what = type(result).__name__
        return {"status": "garbage", "message": f"expected {plugin.name} to return a Reconstruction, got {what}"}
    named = {*result.cameras, *(camera.name for camera in result.cameras.values())}
    if strange := sorted(map(str, named.difference(scene.images))):
        message = f"{plugin.name} returned a camera of {strange[0]!r}, which is not an image of the scene"
        return {"status": "garbage", "message": f"{message}: name cameras as scene.images does"}
    write_cloud(workspace / CLOUD, result.cloud)
    shutil.rmtree(workspace / CAMERAS, ignore_errors=True)
    if result.cameras:
        write_colmap_model(workspace / CAMERAS, list(result.cameras.values()))
    notes = [str(note) for note in result.notes]
    survey = {"survey": result.residuals.plain()} if result.residuals else {}
    origin = {} if result.origin is None else {"origin": list(result.origin)}
    return {"status": "ok", "gauge": result.gauge, "cameras": len(result.cameras), "notes": notes, **survey, **origin}


def _disk_problem(error: Exception, workspace: Path) -> str | None:
    """Return what to do if a disk or the limit of the size of files stopped a run; None for other errors."""
    if not isinstance(error, OSError):
        return None
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"the disk of {workspace} is full: free some space and run it again; finished steps are kept"
    return f"a file is {reason_of(error)}; finished steps are kept" if error.errno == errno.EFBIG else None


def _peak_gpu_bytes() -> int | None:
    """Return the peak memory of torch's allocator, summed over the devices; None if it did not use CUDA."""
    torch: Any = sys.modules.get("torch")
    if torch is None or not torch.cuda.is_available() or not torch.cuda.is_initialized():
        return None
    return sum(int(torch.cuda.max_memory_reserved(device)) for device in range(torch.cuda.device_count()))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
