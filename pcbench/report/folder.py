"""The report folder: written aside and moved into place, so that a failed run changes nothing."""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation import Deformation
from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import is_known
from pcbench.geometry.transform import Similarity, format_matrix
from pcbench.io import write_cloud
from pcbench.measure.deviation import M3C2, DeviationMap
from pcbench.measure.settings import Settings
from pcbench.report.colors import Range, largest_but_strays, ranges
from pcbench.report.comparison import Comparison
from pcbench.report.document import document, to_json
from pcbench.report.figures import FORMATS, Figures
from pcbench.report.inputs import InputFile, Inputs
from pcbench.report.recorded import record, restore
from pcbench.report.table import Row, markdown, rows
from pcbench.scratch import claim, scratch_folder

SETTINGS_SCHEMA = "pcbench.settings/1"
_MARK = "comparison.json"  # a folder that holds it is a report
_DEFORM_MARK = "deformation.json"  # one of `pcbench deform`
_DEFORM_FILES = (_DEFORM_MARK, "deformation.ply", "deformation.csv", "aligned.ply", "T.txt")
_LONGEST_NAME = 220  # bytes: names of files have 255, and what stands after it is `_poisson_distance.png` at most
UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")  # what breaks the lines of tables
_SUFFIXES = (
    "_deformation.csv",
    "_deformation.ply",
    "_deviation.ply",
    "_deviation.laz",
    "_completeness.ply",
    "_m3c2.ply",
    "_T.txt",
)


@contextmanager
def report_folder(out: Path, keep: Sequence[Path] = ()) -> Iterator[Path]:
    """A temporary folder beside `out` that becomes `out` when the block ends well, and vanishes when it does not.

    In an existing report the old report's files are replaced; files of others are left alone.

    Raises:
        InputError: `out` is a file, a folder with something else in it, or holds a file of `keep` (the inputs);
            or another run is writing there.
    """
    for path in keep:
        if path.resolve().is_relative_to(out.resolve()):
            raise InputError(f"{out}: the report would replace its own input {path}: choose another folder")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder to write the report to, got a file")
    if out.is_dir() and any(out.iterdir()) and not any((out / mark).is_file() for mark in (_MARK, _DEFORM_MARK)):
        raise InputError(f"{out}: the folder is not empty and holds no report: choose another one, or empty it")
    created = _make_parents(out.absolute().parent)
    try:
        with claim(out), scratch_folder(out) as scratch:
            yield scratch
            _move_into_place(scratch, out)
    except BaseException:
        for folder in reversed(created):
            if not any(folder.iterdir()):
                folder.rmdir()
        raise


def write_report(folder: Path, comparison: Comparison, figures: Figures | None = None) -> None:
    """Write everything but the pictures of a comparison into an empty folder.

    `figures` says how pictures shall look: its range also colours the clouds, and settings.json holds it.

    settings.json, by which the comparison can be made again, is left out where its clouds came from no files.

    Raises:
        InputError: a candidate's name cannot be part of file names.
    """
    for candidate in comparison:
        check_name(candidate.name)
    (folder / _MARK).write_text(to_json(document(comparison)), encoding="utf-8")
    # File names need not be Unicode.
    (folder / "metrics.csv").write_text(_csv(comparison), encoding="utf-8", errors="backslashreplace")
    (folder / "table.md").write_text(markdown(comparison), encoding="utf-8", errors="backslashreplace")
    if comparison.inputs is not None:
        settings = to_json(_settings(comparison.settings, comparison.inputs, figures or Figures()))
        (folder / "settings.json").write_text(settings, encoding="utf-8")
    _write_maps(folder, comparison, figures or Figures())
    for candidate in comparison.candidates:
        transform = candidate.registration.T_reference_candidate
        (folder / f"{candidate.name}_T.txt").write_text(format_matrix(transform), encoding="utf-8")


def read_settings(path: Path) -> tuple[Settings, Inputs]:
    """Settings and input files of a report's settings.json.

    Raises:
        InputError: the file is not one, or was damaged.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot read settings: {getattr(error, 'strerror', None) or error}") from error
    if not isinstance(values, dict) or values.get("schema") != SETTINGS_SCHEMA:
        raise InputError(f"{path}: expected a settings.json that a report holds (schema {SETTINGS_SCHEMA})")
    try:
        settings = restore(values["settings"])
        candidates = {row["name"]: _recorded(row) for row in values["candidates"]}
        if not candidates or len(candidates) < len(values["candidates"]):
            raise ValueError("candidates need names of their own")
        for name in candidates:
            check_name(name)
        files = tuple(_recorded(row) for row in values.get("files", []))
        return settings, Inputs(_recorded(values["reference"]), candidates, files)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: settings are incomplete or damaged: {error}") from error


def check_name(name: Any) -> str:
    """A candidate's name becomes part of file names.

    Raises:
        InputError: it is empty, reserved, too long, or would lead out of the report's folder.
    """
    reserved = ("", ".", "..", "reference")
    if not isinstance(name, str) or name in reserved or UNPRINTABLE.search(name) or any(c in name for c in "/\\"):
        raise InputError(f"expected a candidate's name that a file can have, other than 'reference', got {name!r}")
    if (size := len(os.fsencode(name))) > _LONGEST_NAME:
        raise InputError(
            f"{name[:20]}...: expected a candidate's name of at most {_LONGEST_NAME} bytes, as the report's files are"
            f" called by it, got {size}: call the file by a shorter one"
        )
    return name


def _recorded(row: dict[str, Any]) -> InputFile:
    if not isinstance(row["path"], str) or not isinstance(row["sha256"], str):
        raise ValueError("path and sha256 have to be text")
    return InputFile(row["path"], row["sha256"])


def _settings(settings: Settings, inputs: Inputs, figures: Figures) -> dict[str, Any]:
    def file(read: InputFile) -> dict[str, Any]:
        return {"path": str(Path(read.path).absolute()), "sha256": read.sha256}

    return {
        "schema": SETTINGS_SCHEMA,
        "reference": file(inputs.reference),
        "candidates": [{"name": name, **file(read)} for name, read in inputs.candidates.items()],
        "files": [file(read) for read in inputs.files],
        "settings": record(settings),
        "figures": figures.plain(),
    }


def _csv(comparison: Comparison) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Row._fields)
    writer.writerows(["" if value is None else value for value in row] for row in rows(comparison))
    return text.getvalue()


def _write_maps(folder: Path, comparison: Comparison, figures: Figures) -> None:
    """NAME_deviation.ply (and .laz where a LAS file came in), NAME_completeness.ply, NAME_m3c2.ply: named scalars, and
    RGB for all viewers.
    """
    reference = comparison.reference
    maps = [{c.name: c.deviation for c in comparison}, {c.name: c.completeness for c in comparison}]
    highest = [{name: largest_but_strays(of.scalars["distance"]) for name, of in by.items()} for by in maps]
    forth, back = (ranges(of, spacing=reference.spacing_median, given=figures.range) for of in highest)
    for candidate in comparison.candidates:
        deviation = candidate.deviation
        cloud = _coloured(deviation, forth[candidate.name], comparison)
        missing = _coloured(candidate.completeness, back[candidate.name], comparison)
        stem = folder / candidate.name
        write_cloud(f"{stem}_deviation.ply", cloud)
        write_cloud(f"{stem}_completeness.ply", missing)
        inputs = comparison.inputs
        if inputs is not None and Path(inputs.candidates[candidate.name].path).suffix.lower() in (".las", ".laz"):
            # A system that only this reference's file knows by name cannot be written to LAS.
            write_cloud(f"{stem}_deviation.laz", cloud if is_known(cloud.crs) else replace(cloud, crs=None))
        if deviation.m3c2 is not None:
            write_cloud(f"{stem}_m3c2.ply", _m3c2_cloud(deviation.m3c2, comparison))
        write_field(f"{stem}_deformation", candidate.deformation, reference.crs, reference.unit)


def _coloured(deviation: DeviationMap, scale: Range, comparison: Comparison) -> Cloud:
    return Cloud(
        deviation.points,
        colors=scale.colors(deviation.scalars["distance"]),
        attributes={name: values.astype(np.float32) for name, values in deviation.scalars.items()},
        crs=comparison.reference.crs,
        unit=comparison.reference.unit,
    )


def write_deformation(
    folder: Path, deformation: Deformation, aligned: Cloud, transform: Similarity, crs: str | None, unit: str | None
) -> None:
    """Write what `pcbench deform` leaves, but for the pictures, into an empty folder."""
    (folder / _DEFORM_MARK).write_text(to_json(deformation), encoding="utf-8")
    write_field(f"{folder}/deformation", deformation, crs, unit)
    write_cloud(folder / "aligned.ply", aligned)
    (folder / "T.txt").write_text(format_matrix(transform), encoding="utf-8")


def write_field(stem: str, deformation: Deformation, crs: str | None, unit: str | None) -> None:
    """STEM.ply and STEM.csv: the displacement of the candidate against the reference, a row for each cell."""
    field = deformation.field
    if field is None:
        return
    columns: dict[str, NDArray[Any]] = {
        **{f"displacement_{axis}": field.displacements[:, k] for k, axis in enumerate("xyz")},
        "vertical": field.vertical,
        "vertical_sigma": field.sigma,
        "local": field.local,
        "changed": field.changed.astype(np.uint8),
        "pairs": field.counts.astype(np.int32),
    }
    write_cloud(f"{stem}.ply", Cloud(field.places, attributes=columns, crs=crs, unit=unit))
    write_cloud(f"{stem}.csv", Cloud(field.places, attributes=columns))


def _m3c2_cloud(found: M3C2, comparison: Comparison) -> Cloud:
    attributes = {
        "m3c2_distance": found.distances.astype(np.float32),
        "lod95": found.lod.astype(np.float32),
        "significant": found.significant.astype(np.float32),
        "count_reference": found.counts_reference.astype(np.int32),
        "count_candidate": found.counts_candidate.astype(np.int32),
    }
    crs, unit = comparison.reference.crs, comparison.reference.unit
    return Cloud(found.cores, normals=found.normals, attributes=attributes, crs=crs, unit=unit)


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
        candidates = [check_name(candidate["name"]) for candidate in doc["candidates"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        candidates = []
    if (out / _DEFORM_MARK).is_file():
        names |= set(_DEFORM_FILES)
    names |= {f"{name}{suffix}" for name in candidates for suffix in _SUFFIXES}
    return [out / name for name in sorted(names) if (out / name).is_file()] + sorted(
        path for ending in FORMATS for path in out.glob(f"figures/*.{ending}")
    )
