"""Which images of a scene can be decoded: one that cannot is left out and named, and does not end the run."""

from __future__ import annotations

import json
from pathlib import Path

from pcbench.errors import ReconstructionError
from pcbench.plugins.stages import stage
from pcbench.scenes import Scene
from pcbench.scenes.decode import why_unreadable

_FAULTS = "faults.json"


def readable(scene: Scene, workspace: Path) -> tuple[Scene, list[str]]:
    """The scene without the images that cannot be decoded, and a warning on each of these.

    Raises:
        ReconstructionError: fewer than two are left.
    """

    def make(folder: Path) -> None:
        faults = {name: why_unreadable(scene.folder / name) for name in scene.images}
        (folder / _FAULTS).write_text(json.dumps({name: why for name, why in faults.items() if why}), encoding="utf-8")

    folder = stage(workspace, "readable", {"scene": scene.fingerprint(cameras=False)}, make)
    faults = json.loads((folder / _FAULTS).read_text(encoding="utf-8"))
    warnings = [f"warning: {name} is left out: {why}" for name, why in faults.items()]
    left = [name for name in scene.images if name not in faults]
    if len(left) < 2:
        raise ReconstructionError(
            f"{len(faults)} of {len(scene)} images cannot be decoded: "
            + "; ".join(f"{name}: {why}" for name, why in list(faults.items())[:3])
        )
    return (scene.select(left) if faults else scene), warnings
