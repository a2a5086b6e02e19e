"""Evaluate clouds against one reference: a report folder as of `pcbench compare`, and the results from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.comparison.request import Request
from pcbench.comparison.result import Comparison
from pcbench.comparison.run import Outputs, run
from pcbench.errors import InputError, RegistrationError, record_error
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Region
from pcbench.io import read_cloud, write_cloud
from pcbench.io.contents import digest
from pcbench.io.json_values import from_json, to_json
from pcbench.measure.presets import Gao2025
from pcbench.measure.results import Candidate
from pcbench.measure.settings import Settings
from pcbench.plugins.stages import stage
from pcbench.registration import Target, local_origin, register
from pcbench.regular_files import read_json
from pcbench.report.plot import draw_if_possible
from pcbench.studies.gao.plan import MVS
from pcbench.studies.gao.results import ReferenceEvaluation

_RESULTS_FILE = "held.json"


@dataclass(frozen=True)
class CloudEvaluation:
    """Results of clouds against one reference.

    Attributes:
        counts: number of points of the reference, before and after the crop; None if no cloud could be measured.
        clouds: results by cloud, or the reasons for failure.
        folder: folder of the report; None if no cloud could be measured.
    """

    counts: tuple[int, int] | None
    clouds: Mapping[str, ReferenceEvaluation]
    folder: Path | None = field(default=None, metadata={"json": False})


def evaluate_against(
    reference: Path, name: str, clouds: Mapping[str, Path], crop: str, out: Path, seed: int
) -> CloudEvaluation:
    """Register clouds to a reference by ICP, crop all to the same region and measure them.

    The results are saved in `out`/against-NAME for later runs. Measures against `mvs` include its Poisson mesh.

    Args:
        reference: file of the reference.
        name: `mvs` or `truth`.
        clouds: files by name.
        crop: region as text, in the reference's coordinates.
        out: output folder.
        seed: random seed.

    Raises:
        MissingExtra: a library is missing. Nothing is saved.
        OSError: a file cannot be read or written. Nothing is saved.
    """
    settings = Settings(crop=crop, presets=("gao2025",), maps=("poisson",) if name == MVS else (), seed=seed)
    key = {
        "reference": digest(reference),
        "clouds": {cloud: digest(path) for cloud, path in clouds.items()},
        "settings": settings.plain(),
        "results": _RESULTS_FILE,
    }

    def compare(files: dict[str, Path], folder: Path) -> Comparison | str:
        """Return the comparison, or the reason why these clouds cannot be compared."""
        try:
            return run(Request.of(reference, files, settings), Outputs(folder, figures=False)).comparison
        except (InputError, RegistrationError) as error:
            return record_error(error)

    def make(folder: Path) -> None:
        failed: dict[str, str] = {}
        # One bad candidate fails the complete comparison. If it fails, find the bad ones and compare the others.
        comparison = compare(dict(clouds), folder)
        if isinstance(comparison, str):
            target = _ReferenceRegion.from_crop(read_cloud(reference), crop)
            failed = {cloud: why for cloud, path in clouds.items() if (why := target.problem(path)) is not None}
            others = {cloud: path for cloud, path in clouds.items() if cloud not in failed}
            if others and isinstance(comparison := compare(others, folder), str):  # the reference is at fault
                failed |= dict.fromkeys(others, comparison)
        (folder / _RESULTS_FILE).write_text(to_json(_evaluations(name, comparison, failed)), encoding="utf-8")

    folder = stage(out, f"against-{name}", key, make)
    evaluation = from_json(CloudEvaluation, read_json(folder / _RESULTS_FILE))
    return evaluation if evaluation.counts is None else replace(evaluation, folder=folder)


def _evaluations(name: str, comparison: Comparison | str, failed: Mapping[str, str]) -> CloudEvaluation:
    """Return the results of a comparison, or of none, and of the clouds that cannot be measured."""
    failures = {cloud: ReferenceEvaluation(name, failure=why) for cloud, why in failed.items()}
    if isinstance(comparison, str):
        return CloudEvaluation(None, failures)
    counts = comparison.reference.points, comparison.reference.points_in_region
    return CloudEvaluation(counts, {**failures, **{each.name: _evaluation(name, each) for each in comparison}})


def draw_maps(folder: Path) -> str | None:
    """Draw the pictures of a report unless they exist; return the reason if that is impossible."""
    return None if (folder / "figures").is_dir() else draw_if_possible(folder).problem


def visible_truth(truth: Path, out: Path) -> Path:
    """Write the part of a true cloud that the cameras saw (its attribute `visible`) and return the file.

    Without the attribute, or if nothing is visible, the cloud is written unchanged. A cloud should not be penalised for
    parts that no photograph shows.
    """

    def make(folder: Path) -> None:
        cloud = read_cloud(truth)
        if "visible" in cloud.attributes and (seen := np.asarray(cloud.attributes["visible"]) != 0).any():
            cloud = cloud.select(np.flatnonzero(seen))
        write_cloud(folder / "truth.ply", cloud)

    return stage(out, "truth", {"cloud": digest(truth)}, make) / "truth.ply"


class _ReferenceRegion(NamedTuple):
    """A reference and the region to evaluate."""

    target: Target
    cloud: Cloud
    region: Region | None

    @classmethod
    def from_crop(cls, cloud: Cloud, crop: str) -> _ReferenceRegion:
        return cls(Target.of(cloud, local_origin(cloud)), cloud, as_region(crop, cloud))

    def problem(self, path: Path) -> str | None:
        """Return one line if a cloud cannot be evaluated, else None."""
        cloud = read_cloud(path)
        try:
            registration = register(self.cloud, cloud, "icp", target=self.target)
        except (InputError, RegistrationError) as error:
            return record_error(error)
        if self.region is None or self.region.contains(registration.T_reference_candidate.apply(cloud.points)).any():
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
