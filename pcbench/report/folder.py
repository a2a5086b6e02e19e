"""The report folder: written aside and moved into place, so that a failed run changes nothing."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.cloud import Cloud
from pcbench.comparison import Candidate, Comparison, Settings
from pcbench.errors import InputError
from pcbench.io import write_cloud
from pcbench.report.document import to_json
from pcbench.report.table import Row, markdown, rows
from pcbench.transform import format_matrix

SETTINGS_SCHEMA = "pcbench.settings/1"
_MARK = "comparison.json"  # a folder that holds it is a report


@dataclass(frozen=True)
class Inputs:
    """Which files a comparison read: path, sha256 and warnings of "reference" and of each candidate by name."""

    reference: dict[str, Any]
    candidates: dict[str, dict[str, Any]] = field(default_factory=dict)

    def by_name(self) -> dict[str, dict[str, Any]]:
        return {"reference": self.reference, **self.candidates}


@contextmanager
def report_folder(out: Path) -> Iterator[Path]:
    """A temporary folder beside `out` that becomes `out` when the block ends well, and vanishes when it does not.

    In an existing report the old report's files are replaced; files of others are left alone.

    Raises:
        InputError: `out` is a file, or a folder with something else in it.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder to write the report to, got a file")
    if out.is_dir() and any(out.iterdir()) and not (out / _MARK).is_file():
        raise InputError(f"{out}: the folder is not empty and holds no report: choose another one, or empty it")
    created = _make_parents(out.absolute().parent)
    try:
        scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.absolute().parent))
        try:
            yield scratch
            # What the system gives new folders, not mkdtemp's private mode.
            mask = os.umask(0)
            os.umask(mask)
            scratch.chmod(0o777 & ~mask)
            _move_into_place(scratch, out)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
    except BaseException:
        for folder in reversed(created):
            if not any(folder.iterdir()):
                folder.rmdir()
        raise


def write_report(folder: Path, comparison: Comparison, doc: dict[str, Any], inputs: Inputs) -> None:
    """Write everything but the pictures of a comparison into an empty folder."""
    (folder / _MARK).write_text(to_json(doc), encoding="utf-8")
    (folder / "metrics.csv").write_text(_csv(doc), encoding="utf-8")
    (folder / "table.md").write_text(markdown(doc), encoding="utf-8")
    (folder / "settings.json").write_text(to_json(_settings(comparison.settings, inputs)), encoding="utf-8")
    for candidate in comparison.candidates:
        write_cloud(folder / f"{candidate.name}_deviation.ply", _deviation_cloud(candidate, comparison))
        transform = candidate.registration.T_reference_candidate
        (folder / f"{candidate.name}_T.txt").write_text(format_matrix(transform), encoding="utf-8")


def read_settings(path: Path) -> tuple[Settings, Inputs]:
    """Settings and input files of a report's settings.json.

    Raises:
        InputError: the file is not one.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot read settings: {getattr(error, 'strerror', None) or error}") from error
    if not isinstance(values, dict) or values.get("schema") != SETTINGS_SCHEMA:
        raise InputError(f"{path}: expected a settings.json that a report holds (schema {SETTINGS_SCHEMA})")
    try:
        chosen = values["settings"]
        thresholds = chosen["thresholds"]
        settings = Settings(
            **{
                **chosen,
                "thresholds": None if thresholds is None else tuple(float(t) for t in thresholds),
                "presets": tuple(chosen["presets"]),
            }
        )
        candidates = {row["name"]: {"path": row["path"], "sha256": row["sha256"]} for row in values["candidates"]}
        return settings, Inputs(values["reference"], candidates)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: settings are incomplete or damaged: {error!r}") from error


def _settings(settings: Settings, inputs: Inputs) -> dict[str, Any]:
    def file(values: dict[str, Any]) -> dict[str, Any]:
        return {"path": str(Path(values["path"]).absolute()), "sha256": values["sha256"]}

    return {
        "schema": SETTINGS_SCHEMA,
        "reference": file(inputs.reference),
        "candidates": [{"name": name, **file(values)} for name, values in inputs.candidates.items()],
        "settings": asdict(settings),
    }


def _csv(doc: dict[str, Any]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Row._fields)
    writer.writerows(["" if value is None else value for value in row] for row in rows(doc))
    return text.getvalue()


def _deviation_cloud(candidate: Candidate, comparison: Comparison) -> Cloud:
    deviation = candidate.deviation
    attributes = {"distance": deviation.distances.astype(np.float32)}
    if deviation.plane_distances is not None:
        attributes["plane_distance"] = deviation.plane_distances.astype(np.float32)
    reference = comparison.reference
    return Cloud(deviation.points, attributes=attributes, crs=reference["crs"], unit=reference["unit"])


def _make_parents(folder: Path) -> list[Path]:
    """Create a folder and its parents; those that did not exist, outermost first."""
    missing = [p for p in (folder, *folder.parents) if not p.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing[::-1]


def _move_into_place(scratch: Path, out: Path) -> None:
    if not out.exists():
        scratch.rename(out)
        return
    for old in _report_files(out):
        if not (scratch / old.relative_to(out)).exists():
            old.unlink()
    for new in sorted(p for p in scratch.rglob("*") if p.is_file()):
        target = out / new.relative_to(scratch)
        target.parent.mkdir(parents=True, exist_ok=True)
        new.replace(target)


def _report_files(out: Path) -> list[Path]:
    """Files in an existing folder that an earlier report wrote."""
    names = {_MARK, "metrics.csv", "table.md", "settings.json"}
    try:
        doc = json.loads((out / _MARK).read_text(encoding="utf-8"))
        candidates = [str(candidate["name"]) for candidate in doc["candidates"]]
    except (OSError, ValueError, KeyError, TypeError):
        candidates = []
    names |= {f"{name}{suffix}" for name in candidates for suffix in ("_deviation.ply", "_T.txt")}
    return [out / name for name in sorted(names) if (out / name).is_file()] + sorted(out.glob("figures/*.png"))
