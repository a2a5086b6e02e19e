"""The bench at the end of `pcbench demo`: sparse SfM, dense MVS and Gaussian splatting on a small synthetic city."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from pcbench.errors import PcbenchError
from pcbench.geometry.cameras import Intrinsics
from pcbench.plugins.run import describe
from pcbench.scenes.synthetic.files import SceneSettings, write_scene
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.render import check_renderer
from pcbench.studies.bench.plan import Axis
from pcbench.studies.bench.runs import BenchJob
from pcbench.studies.bench.score import Rules

_MARK_FILE = ".demo"  # marks a folder that the demo may remove
_EXTENT_M = 120.0  # the smallest city with streets between blocks


def why_not() -> str | None:
    """Return one line on why the demo's bench cannot run here, or None."""
    try:
        check_renderer()
    except PcbenchError as error:
        return str(error)
    splat = describe("splat")  # has all requirements of `sfm` and `mvs`, and more
    return splat.problem or splat.missing


def demo_job(folder: Path, seed: int, step: Callable[[str], None]) -> BenchJob:
    """Create the scene in `folder` and return its bench job. A scene of an earlier demo is replaced.

    Args:
        folder: scene folder.
        seed: random seed of the city.
        step: progress callback.

    Raises:
        PcbenchError: the scene cannot be rendered, or the folder holds something that no demo wrote.
    """
    mark = folder / _MARK_FILE
    if mark.is_file():
        shutil.rmtree(folder)
    city = CitySettings(extent=_EXTENT_M, seed=seed)
    camera = Intrinsics.from_fov(640, 360, 40.0)
    write_scene(folder, SceneSettings(city, 20, camera, "oblique", points=200_000), step)
    mark.touch()
    half = _EXTENT_M / 2  # few images show the fields around the city
    return BenchJob(
        folder,
        folder / "truth" / "cloud.ply",
        ["sfm", "mvs", "splat"],
        # On full-size images mvs and splat would take longer than all other runs together.
        [
            Axis.sweep("image_scale=0.5,1"),
            Axis.sweep("mvs.image_scale=0.35,0.5"),
            Axis.sweep("splat.image_scale=0.5"),
            Axis.sweep("sfm.upsample=false,true"),
            Axis.sweep("splat.cloud=means,surface"),
            Axis.setting("splat.steps=400"),
        ],
        rules=Rules(crop=f"box:{-half:g},{-half:g},-100,{half:g},{half:g},200"),
    )
