"""Images of a scene that can be decoded: unreadable ones are dropped with a warning instead of ending the run."""

from __future__ import annotations

import json
from pathlib import Path

from pcbench.errors import ReconstructionError
from pcbench.plugins.stages import stage
from pcbench.scenes import Scene
from pcbench.scenes.decode import find_decoding_error

_FAULTS = "faults.json"


def drop_unreadable(scene: Scene, workspace: Path) -> tuple[Scene, list[str]]:
    """Drop the images that cannot be decoded, with a warning on each.

    Args:
        scene: Images.
        workspace: Folder of the stages.

    Raises:
        ReconstructionError: Fewer than two images can be decoded.
    """

    def make(folder: Path) -> None:
        faults = {name: find_decoding_error(scene.folder / name) for name in scene.images}
        (folder / _FAULTS).write_text(
            json.dumps({name: reason for name, reason in faults.items() if reason}), encoding="utf-8"
        )

    folder = stage(workspace, "readable", {"scene": scene.fingerprint(cameras=False)}, make)
    faults = json.loads((folder / _FAULTS).read_text(encoding="utf-8"))
    warnings = [f"warning: {name} is left out: {reason}" for name, reason in faults.items()]
    remaining = [name for name in scene.images if name not in faults]
    if len(remaining) < 2:
        raise ReconstructionError(
            f"{len(faults)} of {len(scene)} images cannot be decoded: "
            + "; ".join(f"{name}: {reason}" for name, reason in list(faults.items())[:3])
        )
    return (scene.select(remaining) if faults else scene), warnings
