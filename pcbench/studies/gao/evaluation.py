"""Clouds held against one reference: a report folder as `pcbench compare` makes it, and what the experiment takes from
it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError, RegistrationError, recorded
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Region
from pcbench.io import read_cloud, write_cloud
from pcbench.io.files import digest, read_json
from pcbench.measure.presets import Gao2025
from pcbench.measure.results import Candidate
from pcbench.measure.settings import Settings
from pcbench.plugins.stages import stage
from pcbench.registration import Target, local_origin, register
from pcbench.report import Comparison, to_json
from pcbench.report.compare_files import ComparisonJob, Outputs, compare_files
from pcbench.report.plot import draw_if_possible
from pcbench.studies.gao.plan import MVS
from pcbench.studies.gao.results import ReferenceEvaluation, evaluation_from_json

_RESULTS_FILE = "held.json"


class CloudEvaluation(NamedTuple):
    """Clouds against one reference.

    Attributes:
        folder: of the report; None where no cloud could be measured.
        counts: points of the reference, all and after the crop; None as well.
        clouds: by name, each with what was measured or why it was not.
    """

    folder: Path | None
    counts: tuple[int, int] | None
    clouds: dict[str, ReferenceEvaluation]


def evaluate_against(
    reference: Path, name: str, clouds: Mapping[str, Path], crop: str, out: Path, seed: int
) -> CloudEvaluation:
    """Register clouds to a reference, crop both and measure; kept in `out`/against-NAME for the next run.

    Each is registered by ICP, and all are cropped to the same region. Against `mvs` its Poisson mesh is made too.

    Args:
        reference: its file; name: `mvs` or `truth`.
        clouds: files by name.
        crop: region as text, in the reference's coordinates.

    Raises:
        MissingExtra, OSError: what stands in the way may pass, so that nothing is kept.
    """
    settings = Settings(crop=crop, presets=("gao2025",), maps=("poisson",) if name == MVS else (), seed=seed)
    key = {
        "reference": digest(reference),
        "clouds": {cloud: digest(path) for cloud, path in clouds.items()},
        "settings": settings.plain(),
        "results": _RESULTS_FILE,
    }

    def compare(those: dict[str, Path], folder: Path) -> Comparison | str:
        """The comparison, or why the clouds do not allow one."""
        try:
            job, outputs = ComparisonJob(reference, those, settings, {}), Outputs(folder, figures=False)
            return compare_files(job, outputs, lambda _: None).comparison
        except (InputError, RegistrationError) as error:
            return recorded(error)

    def make(folder: Path) -> None:
        failed: dict[str, str] = {}
        # A comparison has all candidates or none: where it has none, those that cannot be measured are found.
        found = compare(dict(clouds), folder)
        if isinstance(found, str):
            asked = _ReferenceRegion.of(read_cloud(reference), crop)
            failed = {cloud: why for cloud, path in clouds.items() if (why := asked.problem(path)) is not None}
            others = {cloud: path for cloud, path in clouds.items() if cloud not in failed}
            if others and isinstance(found := compare(others, folder), str):  # the reference cannot
                failed |= dict.fromkeys(others, found)
        (folder / _RESULTS_FILE).write_text(to_json(_document(name, found, failed)), encoding="utf-8")

    return _read(stage(out, f"against-{name}", key, make))


def _document(name: str, found: Comparison | str, failed: Mapping[str, str]) -> dict[str, object]:
    """What `_read` reads."""
    clouds = {cloud: ReferenceEvaluation(name, failure=why) for cloud, why in failed.items()}
    if isinstance(found, str):
        return {"counts": None, "clouds": clouds}
    clouds |= {candidate.name: _evaluation(name, candidate) for candidate in found}
    return {"counts": (found.reference.points, found.reference.points_in_region), "clouds": clouds}


def _read(folder: Path) -> CloudEvaluation:
    values = read_json(folder / _RESULTS_FILE)
    clouds = {cloud: evaluation_from_json(row) for cloud, row in values["clouds"].items()}
    counts = values["counts"]
    return (
        CloudEvaluation(None, None, clouds)
        if counts is None
        else CloudEvaluation(folder, (counts[0], counts[1]), clouds)
    )


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

    return stage(out, "truth", {"cloud": digest(truth)}, make) / "truth.ply"


class _ReferenceRegion(NamedTuple):
    """A reference and the region of it that is asked for."""

    target: Target
    cloud: Cloud
    region: Region | None

    @classmethod
    def of(cls, cloud: Cloud, crop: str) -> _ReferenceRegion:
        return cls(Target.of(cloud, local_origin(cloud)), cloud, as_region(crop, cloud))

    def problem(self, path: Path) -> str | None:
        """One line if a cloud cannot be held against it."""
        cloud = read_cloud(path)
        try:
            found = register(self.cloud, cloud, "icp", target=self.target)
        except (InputError, RegistrationError) as error:
            return recorded(error)
        if self.region is None or self.region.contains(found.T_reference_candidate.apply(cloud.points)).any():
            return None
        return f"the region {self.region.describe()} holds none of its {len(cloud):,} points"


def _evaluation(name: str, candidate: Candidate) -> ReferenceEvaluation:
    measures = candidate.metrics.presets["gao2025"]
    assert isinstance(measures, Gao2025)
    return ReferenceEvaluation(
        reference=name,
        points=candidate.points_in_region,
        measures=measures,
        floor=candidate.metrics.d1_mse.accuracy.floor,
        deformation=candidate.deformation,
        doubts=tuple(notice.text for notice in candidate.registration.warnings),
    )
