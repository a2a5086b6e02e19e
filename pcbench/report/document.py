"""`comparison.json`: schema `pcbench.comparison/1`, documented in the README."""

from __future__ import annotations

import json
import math
import os
import platform
import shlex
import subprocess
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import pcbench
from pcbench.geometry.arrays import FloatArray
from pcbench.measure.comparison import Candidate, Comparison
from pcbench.measure.deviation import M3C2, DeviationMap
from pcbench.measure.metrics import percentiles
from pcbench.registration import Registration

SCHEMA = "pcbench.comparison/1"


def document(comparison: Comparison, files: dict[str, dict[str, Any]] | None = None) -> dict[str, Any]:
    """The comparison as JSON-ready values.

    Args:
        files: path, sha256 and warnings of "reference" and of each candidate by name, where clouds came from files.
    """
    files = files or {}
    unread: dict[str, Any] = {"path": None, "sha256": None, "warnings": []}
    values = {
        "schema": SCHEMA,
        "reference": {**unread, **files.get("reference", {}), **comparison.reference},
        "settings": asdict(comparison.settings),
        "provenance": provenance(comparison.settings.seed),
        "candidates": [
            _candidate(candidate, {**unread, **files.get(candidate.name, {})}) for candidate in comparison.candidates
        ],
        "differences": comparison.differences,
    }
    plain: dict[str, Any] = _plain(values)
    return plain


def to_json(values: dict[str, Any]) -> str:
    """JSON text: what does not exist is null, never NaN or Infinity."""
    return json.dumps(_plain(values), indent=2, allow_nan=False) + "\n"


def _candidate(candidate: Candidate, file: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": candidate.name,
        **file,
        "warnings": [*file["warnings"], *candidate.warnings],
        "points": candidate.points,
        "points_in_region": candidate.points_in_region,
        "registration": _registration(candidate.registration),
        "metrics": candidate.metrics,
        "deviation": _deviation(candidate.deviation),
        "deformation": candidate.deformation.values,
        "timings_s": candidate.timings_s,
        "peak_rss_bytes": candidate.peak_rss_bytes,
    }


def _registration(registration: Registration) -> dict[str, Any]:
    return {
        "method": registration.method,
        "T_reference_candidate": registration.T_reference_candidate.matrix,
        "scale": registration.T_reference_candidate.scale,
        "rmse": registration.rmse,
        "overlap": registration.overlap,
        "iterations": registration.iterations,
        "converged": registration.converged,
        "information_eigenvalues": registration.information_eigenvalues,
        "weakest_sigma": registration.weakest_sigma,
        "check_points": [point._asdict() for point in registration.check_points],
        "scale_solved": registration.solved_scale,
        "warnings": [notice.text for notice in registration.warnings],
        "warning_codes": [notice.code for notice in registration.warnings],
    }


def _deviation(deviation: DeviationMap) -> dict[str, Any]:
    """The distances to the nearest points, and under `maps` every other map."""
    distances = deviation.scalars["distance"]
    plane = deviation.scalars.get("plane_distance")
    return {
        "kind": "nearest",
        "percentiles": percentiles(distances),
        "rms": _rms(distances),
        # Distances to points have no sign; the bias is that of the distances to the tangent planes, positive above.
        "bias": None if plane is None else float(np.mean(plane)),
        "maps": {name: _spread(values) for name, values in deviation.scalars.items() if name != "distance"},
        "m3c2": None if deviation.m3c2 is None else _m3c2(deviation.m3c2),
    }


def _m3c2(found: M3C2) -> dict[str, Any]:
    known = np.isfinite(found.distances)
    tested = np.isfinite(found.significant)
    return {
        "core_points": len(found.cores),
        "valid": int(known.sum()),
        "radius": found.radius,
        "half_length": found.half_length,
        "registration_error": found.registration_error,
        "sign": "positive along the reference's normal",
        "lod95_median": float(np.median(found.lod[tested])) if tested.any() else None,
        "significant_share": float(found.significant[tested].mean()) if tested.any() else None,
        **(_spread(found.distances[known]) if known.any() else {"percentiles": None, "rms": None, "bias": None}),
    }


def _spread(values: FloatArray) -> dict[str, Any]:
    return {"percentiles": percentiles(values), "rms": _rms(values), "bias": float(np.mean(values))}


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def provenance(seed: int | None) -> dict[str, Any]:
    """Version, commit, seed, machine, command and time of a result."""
    return {
        "version": pcbench.__version__,
        "commit": _commit(),
        "seed": seed,
        "machine": f"{platform.system()} {platform.machine()}, {len(os.sched_getaffinity(0))} cores,"
        f" Python {platform.python_version()}, numpy {np.__version__}",
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _commit() -> str | None:
    root = Path(pcbench.__file__).parents[1]
    if not (root / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(root), "rev-parse", "HEAD"]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=5).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _plain(value: Any) -> Any:
    """numpy values and tuples as JSON's own, non-finite numbers as null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
