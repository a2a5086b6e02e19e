"""A comparison from files to files: read everything, compare, write; nothing is left unless everything went well."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.io import FILTERED, read_cloud
from pcbench.io.files import atomic_write, check_output, digest
from pcbench.io.meshes import holds_mesh, read_mesh
from pcbench.measure.comparison import Comparison, Settings, compare
from pcbench.report import Inputs, document, report_folder, to_json, write_report
from pcbench.report.folder import check_name, read_settings
from pcbench.report.plot import draw_if_possible

_NAMING_A_FILE = ("matrix:", "points:", "polygon:")  # settings that do


@dataclass(frozen=True)
class Job:
    """What to compare. `expected` holds the sha256 of files (by absolute path) that were recorded before."""

    reference: Path
    candidates: dict[str, Path]
    settings: Settings
    expected: dict[str, str]

    @classmethod
    def of(cls, reference: Path, candidates: Sequence[Path], settings: Settings) -> Job:
        return cls(reference, named(candidates), settings, {})

    @classmethod
    def recorded(cls, settings_file: Path) -> Job:
        """The comparison that a report's settings.json describes."""
        settings, inputs = read_settings(settings_file)
        candidates = {name: Path(row["path"]) for name, row in inputs.candidates.items()}
        rows = (inputs.reference, *inputs.candidates.values(), *inputs.files)
        return cls(Path(inputs.reference["path"]), candidates, settings, {row["path"]: row["sha256"] for row in rows})


@dataclass(frozen=True)
class Outputs:
    """Where results go; `json_file` may not be standard output here."""

    folder: Path | None = None
    json_file: Path | None = None
    figures: bool = True


@dataclass(frozen=True, eq=False)
class Outcome:
    """A comparison, its document, and why there are no pictures where there should be."""

    comparison: Comparison
    document: dict[str, Any]
    without_figures: str | None


def compare_files(job: Job, outputs: Outputs, step: Callable[[str], None]) -> Outcome:
    """Compare files and write the report.

    Raises:
        PcbenchError, OSError: an input, a setting or an output is not usable; nothing was written then.
    """
    settings = replace(job.settings, register=_absolute(job.settings.register), crop=_absolute(job.settings.crop))
    named_files = [Path(text.partition(":")[2]) for text in (settings.register, settings.crop) if _names_file(text)]
    inputs = [job.reference, *job.candidates.values(), *named_files]
    if (settings.classes or settings.returns) and not any(p.suffix.lower() in FILTERED for p in inputs):
        raise InputError("--classes and --returns filter LAS files: none of the clouds is one")
    if outputs.json_file is not None:
        check_output(outputs.json_file, inputs)
    if outputs.folder is None:
        outcome, _ = _run(job, settings, named_files, step)
    else:
        with report_folder(outputs.folder, keep=inputs) as folder:
            outcome, files = _run(job, settings, named_files, step)
            step("writing the report")
            write_report(folder, outcome.comparison, outcome.document, files)
            if outputs.figures:
                step("drawing the pictures")
                outcome = replace(outcome, without_figures=draw_if_possible(folder))
    if outputs.json_file is not None:
        with atomic_write(outputs.json_file) as file:
            file.write(to_json(outcome.document).encode())
    return outcome


def named(paths: Sequence[Path]) -> dict[str, Path]:
    """Each candidate's name: its file's stem, with a number where stems are equal."""
    result: dict[str, Path] = {}
    taken = {path.stem for path in paths} | {"reference"}
    for path in paths:
        name, number = path.stem or "candidate", 2
        if name in result or name == "reference":
            while f"{path.stem}_{number}" in taken:
                number += 1
            name = f"{path.stem}_{number}"
            taken.add(name)
        result[check_name(name)] = path
    return result


def _run(job: Job, settings: Settings, named_files: list[Path], step: Callable[[str], None]) -> tuple[Outcome, Inputs]:
    clouds: dict[str, Cloud | Mesh] = {}
    files: dict[str, dict[str, Any]] = {}
    for name, path in {"reference": job.reference, **job.candidates}.items():
        step(f"reading {path}")
        warnings: list[str] = []
        clouds[name] = _read(path, settings, warnings, may_be_mesh=name == "reference")
        files[name] = {"path": str(path), "sha256": digest(path), "warnings": warnings}
        if job.expected.get(str(path), files[name]["sha256"]) != files[name]["sha256"]:
            warnings.append(f"{path}: the file has changed since the settings were written")
    others = [{"path": str(path), "sha256": digest(path)} for path in named_files]
    files["reference"]["warnings"] += [
        f"{row['path']}: the file has changed since the settings were written"
        for row in others
        if job.expected.get(row["path"], row["sha256"]) != row["sha256"]
    ]
    truth = clouds.pop("reference")
    candidates = {name: cloud for name, cloud in clouds.items() if isinstance(cloud, Cloud)}
    comparison = compare(truth, candidates, settings, on_step=step)
    inputs = Inputs(files["reference"], {name: files[name] for name in candidates}, others)
    return Outcome(comparison, document(comparison, inputs.by_name()), None), inputs


def _read(path: Path, settings: Settings, warnings: list[str], *, may_be_mesh: bool) -> Cloud | Mesh:
    if may_be_mesh and holds_mesh(path):
        return read_mesh(path, on_warning=warnings.append)
    filters: dict[str, Any] = {}
    if path.suffix.lower() in FILTERED:  # a LAS reference may be filtered though the candidates are of another kind
        filters = {"classes": settings.classes, "returns": settings.returns}
    return read_cloud(path, on_warning=warnings.append, **filters)


def _names_file(text: str) -> bool:
    return text.startswith(_NAMING_A_FILE)


def _absolute(text: str) -> str:
    """A setting that names a file, so that it means the same from any folder."""
    kind, _, path = text.partition(":")
    return f"{kind}:{Path(path).absolute()}" if path and _names_file(text) else text
