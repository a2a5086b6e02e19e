"""The report folder, written under a temporary name and renamed, so that a failed run changes nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation import Deformation
from pcbench.errors import InputError, describe_damage, reason_of
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import is_known_crs
from pcbench.geometry.transform import Similarity, format_matrix
from pcbench.io import write_cloud
from pcbench.io.json_values import to_json
from pcbench.io.map_tiles import write_overview
from pcbench.io.paths import input_files
from pcbench.measure.deviation import M3C2, DeviationMap
from pcbench.measure.settings import Settings
from pcbench.regular_files import read_json
from pcbench.report.colors import Range, ranges, robust_maximum
from pcbench.report.document import deformation_values, document
from pcbench.report.figures import Figures
from pcbench.report.html import PAGE, page, write_page
from pcbench.report.inputs import FinishedComparison, InputFile, Inputs
from pcbench.report.manifest import MAPS, check_figures_folder, complete_replacement, is_report, replace_report
from pcbench.report.markup import csv_text
from pcbench.report.names import check_name
from pcbench.report.recorded import record, record_tiling, restore, restore_tiling
from pcbench.report.table import Row, markdown, rows
from pcbench.report.viewing import CAMERAS_FILE, SceneFolder
from pcbench.scratch import lock_output, make_parents, remove_empty, scratch_folder

SETTINGS_SCHEMA = "pcbench.settings/1"
_COMPARISON = "comparison.json"


@contextmanager
def report_folder(out: Path, keep: Sequence[Path] = ()) -> Iterator[Path]:
    """Yield a temporary folder that replaces the report in `out` on success and is removed on failure.

    In an existing report the files in its manifest are replaced, and other files are kept.

    Args:
        out: the report folder.
        keep: input files, and patterns of them, that must not be replaced.

    Raises:
        InputError: `out` is a file, has files but no report, or has a file of `keep`; its `figures` is a link; a file
            that no report wrote has the name of a new one; or another run writes to it.
    """
    for path in (file for named in keep for file in input_files(named)):
        if path.resolve().is_relative_to(out.resolve()):
            raise InputError(f"{out}: the report would replace its input {path}: choose another folder")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder to write the report to, got a file")
    complete_replacement(out)
    if out.is_dir() and any(out.iterdir()) and not is_report(out):
        raise InputError(f"{out}: the folder is not empty and has no report: choose another folder, or empty it")
    check_figures_folder(out)
    target = out.resolve() if out.is_symlink() else out
    created = make_parents(target.absolute().parent)
    try:
        with lock_output(out), scratch_folder(out) as scratch:
            yield scratch
            replace_report(scratch, target)
    except BaseException:
        remove_empty(created)
        raise


def write_report(folder: Path, comparison: FinishedComparison, figures: Figures | None = None) -> str | None:
    """Write a comparison into an empty folder, without its pictures.

    settings.json, which repeats the comparison, is written only if all clouds came from files.

    Args:
        folder: the folder.
        comparison: the comparison.
        figures: appearance of the pictures, recorded in settings.json; its range also applies to coloured clouds.

    Returns:
        The reason why report.html could not be written, if any; all other files do not depend on it.

    Raises:
        InputError: a candidate's name cannot be part of file names.
    """
    for candidate in comparison:
        check_name(candidate.name)
    values = document(comparison)
    (folder / _COMPARISON).write_text(to_json(values), encoding="utf-8")
    # File names need not be Unicode.
    (folder / "metrics.csv").write_text(
        csv_text(Row._fields, rows(comparison)), encoding="utf-8", errors="backslashreplace"
    )
    (folder / "table.md").write_text(markdown(comparison), encoding="utf-8", errors="backslashreplace")
    if comparison.inputs is not None:
        settings = to_json(_settings(comparison.settings, comparison.inputs, figures or Figures()))
        (folder / "settings.json").write_text(settings, encoding="utf-8")
    if comparison.cameras is not None:
        comparison.cameras.write(folder / CAMERAS_FILE)
    _write_maps(folder, comparison, figures or Figures())
    for candidate in comparison.candidates:
        transform = candidate.registration.T_reference_candidate
        (folder / f"{candidate.name}_T.txt").write_text(format_matrix(transform), encoding="utf-8")
    color_range = None if figures is None else figures.range
    return write_page(folder / PAGE, lambda: page(comparison, values["provenance"], color_range))


def read_settings(path: Path) -> tuple[Settings, Inputs]:
    """Return the settings and input files in a report's settings.json.

    Raises:
        InputError: the file is not a settings.json, or is damaged.
    """
    complete_replacement(path.parent)
    try:
        values = read_json(path)
    except (InputError, OSError) as error:
        raise InputError(f"{path}: cannot read settings: {reason_of(error)}") from error
    if not isinstance(values, dict) or values.get("schema") != SETTINGS_SCHEMA:
        raise InputError(f"{path}: expected the settings.json of a report (schema {SETTINGS_SCHEMA})")
    try:
        values.setdefault("files", [])
        kinds = {"settings": (dict, "an object"), "candidates": (list, "a list"), "files": (list, "a list")}
        for key, (kind, name) in kinds.items():
            if not isinstance(values[key], kind):
                raise ValueError(f"expected {key!r} as {name}, got {values[key]!r}")
        if unknown := [name for name in values["settings"] if name not in Settings.__dataclass_fields__]:
            raise ValueError(f"unknown setting {unknown[0]!r}")
        settings = restore(values["settings"])
        candidates = {}
        for row in values["candidates"]:
            (name,) = _texts("a candidate", row, "name")
            candidates[name] = _input_file("a candidate", row)
        if not candidates:
            raise ValueError("expected at least one candidate, got none")
        if len(candidates) < len(values["candidates"]):
            raise ValueError("candidates need different names")
        for name in candidates:
            check_name(name)
        files = tuple(_input_file("a file", row) for row in values["files"])
        scene = None
        if values.get("scene") is not None:
            folder, cameras = _texts("the scene", values["scene"], "path", "cameras")
            scene = SceneFolder(Path(folder), cameras)
        tiling = None if values.get("tiling") is None else restore_tiling(values["tiling"])
        return settings, Inputs(_input_file("the reference", values["reference"]), candidates, files, scene, tiling)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: settings are incomplete or damaged: {describe_damage(error)}") from error


def _input_file(owner: str, row: Any) -> InputFile:
    path, sha256 = _texts(owner, row, "path", "sha256")
    return InputFile(path, sha256)


def _texts(owner: str, row: Any, *keys: str) -> list[str]:
    """Return the texts of an object by their keys.

    Raises:
        ValueError: the row is no object, or a value is no text or has a NUL, which no file name can have.
        KeyError: a value is missing.
    """
    if not isinstance(row, dict):
        raise ValueError(f"expected {owner} as an object, got {row!r}")
    for key in keys:
        if not isinstance(row[key], str) or "\0" in row[key]:
            raise ValueError(f"expected {key!r} of {owner} as a text, got {row[key]!r}")
    return [row[key] for key in keys]


def _settings(settings: Settings, inputs: Inputs, figures: Figures) -> dict[str, Any]:
    def file(read: InputFile) -> dict[str, Any]:
        return {"path": str(Path(read.path).absolute()), "sha256": read.sha256}

    scene = None if inputs.scene is None else inputs.scene.absolute()
    return {
        "schema": SETTINGS_SCHEMA,
        "reference": file(inputs.reference),
        "candidates": [{"name": name, **file(read)} for name, read in inputs.candidates.items()],
        "files": [file(read) for read in inputs.files],
        **({} if scene is None else {"scene": {"path": str(scene.path), "cameras": scene.cameras}}),
        "settings": record(settings),
        **({} if inputs.tiling is None else {"tiling": record_tiling(inputs.tiling)}),
        "figures": figures.plain(),
    }


def _write_maps(folder: Path, comparison: FinishedComparison, figures: Figures) -> None:
    """Write NAME_deviation.ply (and .laz for a LAS input), NAME_completeness.ply, NAME_m3c2.ply, and GeoTIFF in maps/.

    The clouds have named scalars, and RGB for viewers that show no scalars.
    """
    reference = comparison.reference
    maps = [{c.name: c.deviation for c in comparison}, {c.name: c.completeness for c in comparison}]
    highest = [
        {name: robust_maximum(map_.even_values("distance")) for name, map_ in by_name.items()} for by_name in maps
    ]
    to_reference, to_candidate = (
        ranges(maxima, spacing=reference.spacing_median, end=figures.range) for maxima in highest
    )
    for candidate in comparison.candidates:
        deviation = candidate.deviation
        cloud = _colour_cloud(deviation, to_reference[candidate.name], comparison)
        missing = _colour_cloud(candidate.completeness, to_candidate[candidate.name], comparison)
        stem = folder / candidate.name
        write_cloud(f"{stem}_deviation.ply", cloud)
        write_cloud(f"{stem}_completeness.ply", missing)
        inputs = comparison.inputs
        if inputs is not None and Path(inputs.candidates[candidate.name].path).suffix.lower() in (".las", ".laz"):
            # LAS needs a coordinate system with a known definition, not just a name.
            laz = cloud if is_known_crs(cloud.crs) else replace(cloud, crs=None, unit=None)
            with suppress(InputError):  # the .ply holds coordinates that 32 bits cannot store
                write_cloud(f"{stem}_deviation.laz", laz)
        if deviation.m3c2 is not None:
            write_cloud(f"{stem}_m3c2.ply", _m3c2_cloud(deviation.m3c2, comparison))
        for kind, overview in {"distance": deviation.overview, "completeness": candidate.completeness.overview}.items():
            if overview is not None:
                (folder / MAPS).mkdir(exist_ok=True)
                write_overview(
                    folder / MAPS, candidate.name, overview, kind=kind, crs=reference.crs, unit=reference.unit
                )
        write_field(f"{stem}_deformation", candidate.deformation, reference.crs, reference.unit)


def _colour_cloud(deviation: DeviationMap, scale: Range, comparison: FinishedComparison) -> Cloud:
    """Return the points with their scalars, those of an even sample first: comparison.json has their number."""
    rows = slice(None) if deviation.sample_step is None else np.argsort(~deviation.is_even, kind="stable")
    return Cloud(
        deviation.points[rows],
        colors=scale.colors(deviation.scalars["distance"][rows]),
        attributes={name: values[rows].astype(np.float32) for name, values in deviation.scalars.items()},
        crs=comparison.reference.crs,
        unit=comparison.reference.unit,
    )


def write_deformation(
    folder: Path, deformation: Deformation, aligned: Cloud, transform: Similarity, crs: str | None, unit: str | None
) -> None:
    """Write the results of `pcbench deform` into an empty folder, without pictures.

    Args:
        folder: the folder.
        deformation: the verdict.
        aligned: the candidate after registration.
        transform: maps candidate to reference coordinates.
        crs: coordinate system of the reference, if known.
        unit: unit of lengths, if known.
    """
    (folder / "deformation.json").write_text(to_json(deformation_values(deformation)), encoding="utf-8")
    write_field(f"{folder}/deformation", deformation, crs, unit)
    write_cloud(folder / "aligned.ply", aligned)
    (folder / "T.txt").write_text(format_matrix(transform), encoding="utf-8")


def write_field(stem: str, deformation: Deformation, crs: str | None, unit: str | None) -> None:
    """Write STEM.ply and STEM.csv: the displacement of the candidate relative to the reference, one row per cell."""
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


def _m3c2_cloud(result: M3C2, comparison: FinishedComparison) -> Cloud:
    attributes = {
        "m3c2_distance": result.distances.astype(np.float32),
        "lod95": result.lod.astype(np.float32),
        "significant": result.significant.astype(np.float32),
        "count_reference": result.counts_reference.astype(np.int32),
        "count_candidate": result.counts_candidate.astype(np.int32),
    }
    crs, unit = comparison.reference.crs, comparison.reference.unit
    return Cloud(result.cores, normals=result.normals, attributes=attributes, crs=crs, unit=unit)
