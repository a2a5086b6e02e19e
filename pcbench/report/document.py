"""`comparison.json` and the JSON of registrations; their schemas are documented in docs/comparison-json.md."""

from __future__ import annotations

import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, fields
from datetime import UTC, datetime
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.deformation import Deformation
from pcbench.extras import package_version
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.datums import StatedSystem
from pcbench.io.json_values import json_values
from pcbench.measure.deviation import M3C2
from pcbench.measure.presets import Preset
from pcbench.measure.quantities import quantities
from pcbench.measure.quantity import Quantity
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE, Candidate
from pcbench.registration import Registration
from pcbench.report.conditions import NamedValues
from pcbench.report.inputs import FinishedComparison, InputFile
from pcbench.systems import cpu_count

SCHEMA = "pcbench.comparison/1"
REGISTRATION_SCHEMA = "pcbench.registration/1"
OMITTED_KEYS = ("metrics",)
"""Keys of candidates that names in conditions may omit."""

_CODE_PATHS = ("pcbench", "reconstructors", "CMakeLists.txt", "pyproject.toml")


def document(comparison: FinishedComparison) -> dict[str, Any]:
    """Return a comparison as JSON values."""
    inputs = comparison.inputs
    values = {
        "schema": SCHEMA,
        "reference": _reference(comparison),
        "settings": comparison.settings.plain(),
        "provenance": provenance(comparison.settings.seed),
        "tiling": _tiling(comparison),
        "candidates": [
            _candidate(candidate, None if inputs is None else inputs.candidates[candidate.name])
            for candidate in comparison.candidates
        ],
        "differences": [
            {"a": d.a, "b": d.b, "metric": d.metric, "difference": d.difference, "ci": d.interval}
            for d in comparison.differences
        ],
    }
    plain: dict[str, Any] = json_values(values)
    return plain


def candidate_values(values: Mapping[str, Any]) -> list[NamedValues]:
    """Return the candidates of a comparison's document, on which conditions are tested; each with the reference."""
    return [
        NamedValues(candidate["name"], {**candidate, "reference": values["reference"]})
        for candidate in values["candidates"]
    ]


def registration_document(
    registration: Registration, reference: InputFile, candidate: InputFile, centroid: FloatArray, unit: str | None
) -> dict[str, Any]:
    """Return a registration of two files as JSON values, with the schema `pcbench.registration/1`.

    Args:
        registration: the registration.
        reference: the file of the reference.
        candidate: the file of the candidate.
        centroid: (3,) centroid of the candidate's points; the motion is that of this point.
        unit: the unit of lengths, if known.
    """
    motion = registration.T_reference_candidate.motion_at(centroid)
    values = {
        "schema": REGISTRATION_SCHEMA,
        "reference": asdict(reference),
        "candidate": asdict(candidate),
        "unit": unit,
        "registration": _registration(registration),
        "motion": {"at": centroid, **motion._asdict()},
        "provenance": provenance(None),
    }
    plain: dict[str, Any] = json_values(values)
    return plain


def deformation_values(deformation: Deformation) -> dict[str, Any]:
    """Return the values of `deformation.json`: those that a comparison has, and the changes."""
    values: dict[str, Any] = json_values(deformation)
    return {**values, "changes": deformation.changes}


def _file(file: InputFile | None) -> dict[str, Any]:
    return {"path": None, "sha256": None, "warnings": [], "system": None} if file is None else asdict(file)


def _reference(comparison: FinishedComparison) -> dict[str, Any]:
    reference = comparison.reference
    file_values = _file(None if comparison.inputs is None else comparison.inputs.reference)
    return {
        **file_values,
        **{field.name: getattr(reference, field.name) for field in fields(reference)},
        "warnings": [*file_values["warnings"], *reference.warnings],
        "system": asdict(StatedSystem.of(reference.crs, reference.unit)),
    }


def _tiling(comparison: FinishedComparison) -> dict[str, Any] | None:
    """Return how a comparison was computed in tiles, and whether its maps have files of all points."""
    tiling = comparison.tiling
    if tiling is None:
        return None
    values = {item.name: getattr(tiling, item.name) for item in fields(tiling)}
    left_out = [file._asdict() for file in tiling.left_out]
    return {**values, "left_out": left_out, "map_files": comparison.has_map_files}


def _map_samples(candidate: Candidate) -> dict[str, Any]:
    """Return the size of each map that is a sample of the measured points, by direction."""
    maps = {CANDIDATE_TO_REFERENCE: candidate.deviation, REFERENCE_TO_CANDIDATE: candidate.completeness}
    return {
        direction: {
            "points": len(map_.points),
            "even": int(np.count_nonzero(map_.is_even)),
            "sampled_from": map_.sampled_from,
        }
        for direction, map_ in maps.items()
        if map_.sampled_from is not None
    }


def _candidate(candidate: Candidate, file: InputFile | None) -> dict[str, Any]:
    file_values = _file(file)
    return {
        "name": candidate.name,
        **file_values,
        "warnings": [*file_values["warnings"], *candidate.warnings],
        "points": candidate.points,
        "points_in_region": candidate.points_in_region,
        "faces": candidate.faces,
        "steps": candidate.steps,
        "censored": candidate.censored,
        "map_samples": _map_samples(candidate),
        "registration": _registration(candidate.registration),
        **_measurements(candidate),
        "offset": None if candidate.offset is None else candidate.offset._asdict(),
        "changes": None if candidate.changes is None else candidate.changes.found,
        "deformation": candidate.deformation,
        "check_points": candidate.check_points,
        "timings_s": candidate.timings_s,
        "peak_rss_bytes": candidate.peak_rss_bytes,
    }


def _measurements(candidate: Candidate) -> dict[str, Any]:
    """Return `metrics`, `budget` and `deviation`: each quantity at its path, and values that are not single numbers."""
    m, deviation = candidate.metrics, candidate.deviation
    lists = {name: _empty_lists(preset) for name, preset in m.presets.items()}
    tree: dict[str, Any] = {
        "metrics": {"fscore": [], "spreads": {}, "presets": lists, "own": {}},
        "budget": None,
        "deviation": {"maps": {}, "m3c2": None},
    }
    for quantity in quantities(candidate):
        if quantity.path:
            _insert(tree, quantity)
    metrics, budget, maps = tree["metrics"], tree["budget"], tree["deviation"]
    if candidate.budget is not None:
        budget["keeps_pose"] = candidate.budget.keeps_pose
        for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
            directed = candidate.budget[direction]
            budget[direction] |= {key: getattr(directed, key) for key in ("mean_square", "floor", "of_changes")}
    metrics["hausdorff"]["worst_point"] = {
        direction: m.hausdorff[direction].worst_point for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE)
    }
    metrics["percentiles"] = {
        CANDIDATE_TO_REFERENCE: m.percentiles_accuracy,
        REFERENCE_TO_CANDIDATE: m.percentiles_completeness,
    }
    for kind, spread in m.spreads.items():
        for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
            values = metrics["spreads"][kind][direction]
            values["percentiles"] = spread[direction].percentiles
            values.setdefault("bias", None)  # unsigned distances have a mean instead
    if m.d2_samples:
        metrics["d2_mse"]["sample"] = {direction: sample._asdict() for direction, sample in m.d2_samples.items()}
    for name, values in maps["maps"].items():
        values["percentiles"] = deviation.spreads[name].percentiles
        values.setdefault("bias", None)
    if deviation.m3c2 is not None:
        maps["m3c2"].update(_m3c2(deviation.m3c2))
    distances, plane = deviation.spreads["distance"], deviation.spreads.get("plane_distance")
    # Distances to points have no sign, so the bias is that of the signed distances to the tangent planes.
    bias = None if plane is None else plane.bias
    nearest = {"kind": "nearest", "percentiles": distances.percentiles, "rms": distances.rms, "bias": bias}
    return {"metrics": metrics, "budget": budget, "deviation": {**nearest, **maps}}


def _insert(tree: dict[str, Any], quantity: Quantity) -> None:
    """Insert a quantity at its path, and its interval under the key `ci` beside it."""
    node: Any = tree
    for key, next_key in pairwise(quantity.path):
        if isinstance(key, int):  # a list with one object per threshold
            if key == len(node):
                node.append({"threshold": quantity.threshold})
        elif node.get(key) is None:
            node[key] = [] if isinstance(next_key, int) else {}
        node = node[key]
    node[quantity.path[-1]] = quantity.value
    if quantity.has_interval:
        node.setdefault("ci", {})[quantity.path[-1]] = quantity.interval


def _empty_lists(preset: Preset) -> dict[str, Any]:
    """Return empty lists for the list fields of a preset, which exist even without thresholds."""
    return {key: [] for key, value in vars(preset).items() if isinstance(value, tuple)}


def _registration(registration: Registration) -> dict[str, Any]:
    return {
        "method": registration.method,
        "T_reference_candidate": registration.T_reference_candidate.matrix,
        "scale": registration.T_reference_candidate.scale,
        "rmse": registration.rmse,
        "overlap": registration.overlap,
        "overlap_distance": registration.overlap_distance,
        "iterations": registration.iterations,
        "converged": registration.converged,
        "information_eigenvalues": registration.information_eigenvalues,
        "weakest_sigma": registration.weakest_sigma,
        "motion": _motion(registration),
        **registration.residuals.plain(),
        "scale_solved": registration.solved_scale,
        "contrast": registration.contrast,
        "returned_share": registration.returned_share,
        "warnings": [notice.text for notice in registration.warnings],
        "warning_codes": [notice.code for notice in registration.warnings],
        "doubtful": registration.doubtful,
    }


def _motion(registration: Registration) -> dict[str, Any] | None:
    """Return the motion that registration removed, and what the given coordinates mean; None for a given pose."""
    motion = registration.motion
    if motion is None:
        return None
    return {
        **{item.name: getattr(motion, item.name) for item in fields(motion)},
        "size": motion.size,
        "half_width": motion.half_width,
        "shares_crs": registration.shares_crs,
        "is_shift": motion.is_shift,
        "rms_as_given": registration.rms_as_given,
    }


def _m3c2(m3c2: M3C2) -> dict[str, Any]:
    return {
        "core_points": len(m3c2.cores),
        "valid": int(np.isfinite(m3c2.distances).sum()),
        "radius": m3c2.radius,
        "half_length": m3c2.half_length,
        "registration_error": m3c2.registration_error,
        "sign": "positive along the reference's normal",
        "percentiles": m3c2.spread.percentiles,
    }


def provenance(seed: int | None) -> dict[str, Any]:
    """Return version, commit, seed, machine, command and time of a result."""
    return {
        "version": package_version(),
        "commit": _running_commit(),
        "seed": seed,
        "machine": f"{platform.system()} {platform.machine()}, {cpu_count()} cores,"
        f" Python {platform.python_version()}, numpy {np.__version__}",
        "command": shlex.join([_program(), *sys.argv[1:]]),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _program() -> str:
    """Return the name of the running program; `python -m pcbench` is the command `pcbench`."""
    path = Path(sys.argv[0])
    return "pcbench" if path.name == "__main__.py" and "pcbench" in path.parts else path.name


@cache
def _running_commit() -> str | None:
    """Return the commit of the code that runs. It is read once, because files that change later are not loaded."""
    return _commit(Path(__file__).parents[2])


def _commit(root: Path) -> str | None:
    """Return the commit of the source tree at `root`, and whether its code has changed; None without a repository."""
    if not (root / ".git").exists():
        return None
    try:
        commit = _git(root, "rev-parse", "HEAD")
        changed = _git(root, "status", "--porcelain", "--", *_CODE_PATHS)
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{commit} with uncommitted changes" if changed else commit


def _git(root: Path, *words: str) -> str:
    command = ["git", "--no-optional-locks", "-C", str(root), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=5).stdout.strip()
