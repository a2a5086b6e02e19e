"""Injected deformations: would one like the paper's be found, and attributed to the right cloud, without a truth?

Gao et al. see a deformation that grows with distance and height, and cannot say which of two clouds has it. Here such a
deformation of known size is added to one cloud at a time, also to the reference `mvs`. A cloud that alone deviates from
`mvs` is deformed itself; if most of the clouds that could show the deformation deviate, `mvs` is deformed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcbench.deformation import Deformation, deform
from pcbench.errors import InputError, RegistrationError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.region_text import as_region
from pcbench.io import read_cloud
from pcbench.io.contents import digest
from pcbench.io.json_values import from_json, to_json
from pcbench.plugins.stages import stage
from pcbench.regular_files import read_json
from pcbench.studies.gao.plan import MVS
from pcbench.studies.gao.results import InjectedDeformation

_SHARES = (0.004, 0.008, 0.016)  # RMS of the injected deformations, in half widths of the region
_RESULTS_FILE = "injected.json"
_NON_AFFINE = "non-affine"


def inject_deformations(
    reference: Path, clouds: Mapping[str, Path], crop: str, out: Path, seed: int
) -> tuple[InjectedDeformation, ...]:
    """Deform each cloud and the reference in turn, and return what the verdicts against the reference say.

    The results are saved in `out`/injected for later runs.

    Args:
        reference: file of `mvs`.
        clouds: files of the other clouds by name.
        crop: region as text, in the reference's coordinates.
        out: output folder.
        seed: random seed.
    """
    key = {
        "reference": digest(reference),
        "clouds": {name: digest(path) for name, path in clouds.items()},
        "crop": crop,
        "seed": seed,
    }

    def make(folder: Path) -> None:
        results = _inject(read_cloud(reference), {name: read_cloud(path) for name, path in clouds.items()}, crop, seed)
        (folder / _RESULTS_FILE).write_text(to_json(results), encoding="utf-8")

    values = read_json(stage(out, "injected", key, make) / _RESULTS_FILE)
    return tuple(from_json(InjectedDeformation, each) for each in values)


def _inject(reference: Cloud, clouds: Mapping[str, Cloud], crop: str, seed: int) -> list[InjectedDeformation]:
    region = as_region(crop, reference)
    inside = reference.points if region is None else reference.points[region.contains(reference.points)]
    if len(inside) < 2 or not np.ptp(np.percentile(inside, [1, 99], axis=0), axis=0).all():
        return []  # without an extent along every axis the displacement cannot grow
    field = _GrowingDisplacement(inside)

    def assess(reference: Cloud, candidate: Cloud) -> Deformation | None:
        try:
            return deform(reference, candidate, "icp", crop, seed)[1]
        except (InputError, RegistrationError):
            return None

    usual = {name: assess(reference, cloud) for name, cloud in clouds.items()}
    results = []
    for share in _SHARES:
        rms = float(f"{share * field.half_width:.1g}")  # the same in scenes of about the same size
        for name, cloud in clouds.items():
            verdicts = {**usual, name: assess(reference, field.add_to(cloud, rms))}
            results.append(_result(name, rms, verdicts))
        deformed = field.add_to(reference, rms)
        results.append(_result(MVS, rms, {name: assess(deformed, cloud) for name, cloud in clouds.items()}))
    return results


class _GrowingDisplacement:
    """Displacements of RMS length 1 that sink with the squared distance and lean with the squared height."""

    def __init__(self, inside: FloatArray) -> None:
        low, high = np.percentile(inside, [1, 99], axis=0)
        self.half_width = float((high - low)[:2].max()) / 2
        self._origin = np.array([*((low + high) / 2)[:2], low[2]])
        self._scale = 1.0
        self._scale = 1 / float(np.sqrt(np.square(self._displacements(inside)).sum(axis=1).mean()))

    def _displacements(self, points: FloatArray) -> FloatArray:
        x, y, z = ((points - self._origin) / self.half_width).T
        displacements: FloatArray = self._scale * np.stack([z * np.abs(z), 0 * x, -(x * x + y * y)], axis=1)
        return displacements

    def add_to(self, cloud: Cloud, rms: float) -> Cloud:
        """Return a cloud with displacements of this RMS over the region."""
        return replace(cloud, points=cloud.points + rms * self._displacements(cloud.points))


def _result(deformed: str, rms: float, deformations: Mapping[str, Deformation | None]) -> InjectedDeformation:
    labels = {name: "failed" if each is None else each.label for name, each in deformations.items()}
    sizes = {
        name: each.amplitude.rms
        for name, each in deformations.items()
        if each is not None and each.amplitude is not None and each.assuming_pose().verdict == _NON_AFFINE
    }
    limits = {
        name: each.size_limit for name, each in deformations.items() if each is not None and each.verdict != "undecided"
    }
    return InjectedDeformation(deformed, rms, labels, sizes, attribute(sizes, limits))


def attribute(sizes: Mapping[str, float], limits: Mapping[str, float | None]) -> str | None:
    """Return the cloud that a deformation belongs to; None if it is not found, or may belong to several.

    Args:
        sizes: RMS deformation against the reference, of the clouds that are found deformed.
        limits: smallest deformation that each cloud with a verdict would show; None if unknown. A cloud whose pose is
            doubted shows nothing.
    """
    if not sizes:
        return None
    smallest = min(sizes.values())
    able = [name for name, limit in limits.items() if name in sizes or (limit is not None and limit < smallest)]
    if len(sizes) == 1:
        return next(iter(sizes)) if len(able) > 1 else None
    return MVS if len(sizes) > len(able) / 2 else None
