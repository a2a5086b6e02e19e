"""Clouds held against one reference: a report folder as `pcbench compare` makes it, and what the experiment takes from
it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.deformation import Deformation
from pcbench.errors import PcbenchError, recorded
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Region
from pcbench.io import read_cloud, write_cloud
from pcbench.io.files import digest, read_json
from pcbench.measure.presets import Gao2025
from pcbench.measure.results import FORTH
from pcbench.measure.settings import Settings
from pcbench.plugins.stages import library_versions, stage
from pcbench.registration import Target, local_origin, register
from pcbench.report.compare_files import ComparisonJob, Outputs, compare_files
from pcbench.report.plot import draw_if_possible
from pcbench.studies.gao.plan import MVS
from pcbench.studies.gao.results import Against

_FAILED = "failed.json"
_COMPARISON = "comparison.json"


class Held(NamedTuple):
    """Clouds against one reference.

    Attributes:
        folder: of the report; None where no cloud could be measured.
        counts: points of the reference, all and after the crop; None as well.
        clouds: by name, each with what was measured or why it was not.
    """

    folder: Path | None
    counts: tuple[int, int] | None
    clouds: dict[str, Against]


def hold(reference: Path, name: str, clouds: Mapping[str, Path], crop: str, out: Path, seed: int) -> Held:
    """Register clouds to a reference, crop both and measure; kept in `out`/against-NAME for the next run.

    Each is registered by ICP, and all are cropped to the same region. Against `mvs` its Poisson mesh is made too.

    Args:
        reference: its file; name: `mvs` or `truth`.
        clouds: files by name.
        crop: region as text, in the reference's coordinates.
    """
    settings = Settings(crop=crop, presets=("gao2025",), maps=("poisson",) if name == MVS else (), seed=seed)
    key = {
        "reference": digest(reference),
        "clouds": {cloud: digest(path) for cloud, path in clouds.items()},
        "settings": settings.plain(),
        "versions": library_versions(),
    }

    def compare(those: dict[str, Path], folder: Path) -> str | None:
        """Why it cannot be done, if so."""
        try:
            compare_files(ComparisonJob(reference, those, settings, {}), Outputs(folder, figures=False), lambda _: None)
        except PcbenchError as error:
            return recorded(error)
        return None

    def make(folder: Path) -> None:
        failed: dict[str, str] = {}
        # A comparison has all candidates or none: where it has none, those that cannot be measured are found.
        if compare(dict(clouds), folder) is not None:
            asked = _Asked.of(read_cloud(reference), crop)
            failed = {cloud: why for cloud, path in clouds.items() if (why := asked.why_not(path)) is not None}
            others = {cloud: path for cloud, path in clouds.items() if cloud not in failed}
            if others and (why := compare(others, folder)) is not None:  # the reference cannot
                failed |= dict.fromkeys(others, why)
        (folder / _FAILED).write_text(json.dumps(failed), encoding="utf-8")

    folder = stage(out, f"against-{name}", key, make)
    failed = {cloud: Against(name, failure=why) for cloud, why in read_json(folder / _FAILED).items()}
    if not (folder / _COMPARISON).is_file():
        return Held(None, None, failed)
    document = read_json(folder / _COMPARISON)
    found = {row["name"]: _against(name, row) for row in document["candidates"]}
    counts = document["reference"]["points"], document["reference"]["points_in_region"]
    return Held(folder, counts, {**failed, **found})


def draw_maps(folder: Path) -> str | None:
    """The pictures of a report, unless they are there; what stands in the way."""
    return None if (folder / "figures").is_dir() else draw_if_possible(folder)


def visible_truth(truth: Path, out: Path) -> Path:
    """What cameras saw of a true cloud (its attribute `visible`, where it has one), as a file: a cloud that lacks what
    no photograph shows is not to blame."""

    def make(folder: Path) -> None:
        cloud = read_cloud(truth)
        if "visible" in cloud.attributes and (seen := np.asarray(cloud.attributes["visible"]) != 0).any():
            cloud = cloud.select(np.flatnonzero(seen))
        write_cloud(folder / "truth.ply", cloud)

    return stage(out, "truth", {"cloud": digest(truth), "versions": library_versions()}, make) / "truth.ply"


class _Asked(NamedTuple):
    """A reference and the region of it that is asked for."""

    target: Target
    cloud: Cloud
    region: Region | None

    @classmethod
    def of(cls, cloud: Cloud, crop: str) -> _Asked:
        return cls(Target.of(cloud, local_origin(cloud)), cloud, as_region(crop, cloud))

    def why_not(self, path: Path) -> str | None:
        """One line if a cloud cannot be held against it."""
        cloud = read_cloud(path)
        try:
            found = register(self.cloud, cloud, "icp", target=self.target)
        except PcbenchError as error:
            return recorded(error)
        if self.region is None or self.region.contains(found.T_reference_candidate.apply(cloud.points)).any():
            return None
        return f"the region {self.region.describe()} holds none of its {len(cloud):,} points"


def _against(name: str, row: Mapping[str, Any]) -> Against:
    return Against(
        reference=name,
        points=row["points_in_region"],
        measures=Gao2025(**row["metrics"]["presets"]["gao2025"]),
        floor=row["metrics"]["d1_mse"]["floor"][FORTH],
        deformation=Deformation.from_json(row["deformation"]),
        doubts=tuple(row["registration"]["warnings"]),
    )
