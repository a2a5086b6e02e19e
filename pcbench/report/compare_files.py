"""A comparison from files to files: read everything, compare, write; nothing is left unless everything went well."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.io import FILTERED, read_cloud
from pcbench.io.files import atomic_write, check_output, digest, named_file, reading_seconds
from pcbench.io.meshes import holds_mesh, read_mesh
from pcbench.measure.settings import Settings
from pcbench.progress import Plan
from pcbench.report.comparison import Comparison, compare
from pcbench.report.document import document, to_json
from pcbench.report.figures import Figures, recorded_figures
from pcbench.report.folder import check_name, read_settings, report_folder, write_report
from pcbench.report.inputs import InputFile, Inputs
from pcbench.report.plot import draw_if_possible, drawing_seconds

_Setting = TypeVar("_Setting")


@dataclass(frozen=True)
class ComparisonJob:
    """What to compare, and how its pictures look. `expected` holds the sha256 of files (by absolute path) that were
    recorded before.
    """

    reference: Path
    candidates: dict[str, Path]
    settings: Settings
    expected: dict[str, str]
    figures: Figures = field(default_factory=Figures)

    @classmethod
    def of(
        cls, reference: Path, candidates: Sequence[Path], settings: Settings, figures: Figures | None = None
    ) -> ComparisonJob:
        return cls(reference, named(candidates), settings, {}, figures or Figures())

    @classmethod
    def recorded(cls, settings_file: Path) -> ComparisonJob:
        """The comparison that a report's settings.json describes."""
        settings, inputs = read_settings(settings_file)
        candidates = {name: Path(file.path) for name, file in inputs.candidates.items()}
        expected = {file.path: file.sha256 for file in inputs.all()}
        return cls(Path(inputs.reference.path), candidates, settings, expected, recorded_figures(settings_file))


@dataclass(frozen=True)
class Outputs:
    """Where results go; `json_file` may not be standard output here."""

    folder: Path | None = None
    json_file: Path | None = None
    figures: bool = True


@dataclass(frozen=True, eq=False)
class ComparisonOutcome:
    """A comparison, and why there are no pictures where there should be."""

    comparison: Comparison
    without_figures: str | None = None


def compare_files(job: ComparisonJob, outputs: Outputs, step: Callable[[str], None]) -> ComparisonOutcome:
    """Compare files and write the report.

    Raises:
        PcbenchError, OSError: an input, a setting or an output is not usable; nothing was written then.
    """
    settings = replace(job.settings, register=_absolute(job.settings.register), crop=_absolute(job.settings.crop))
    named_files = [*filter(None, map(named_file, (settings.register, settings.crop)))]
    inputs = [job.reference, *job.candidates.values(), *named_files]
    if (settings.classes or settings.returns) and not any(p.suffix.lower() in FILTERED for p in inputs):
        raise InputError("--classes and --returns filter LAS files: none of the clouds is one")
    if outputs.json_file is not None:
        check_output(outputs.json_file, inputs)
    plan = Plan(step, _expected_seconds(job, outputs))
    if outputs.folder is None:
        outcome = ComparisonOutcome(_run(job, settings, named_files, plan))
    else:
        with report_folder(outputs.folder, keep=inputs) as folder:
            outcome = ComparisonOutcome(_run(job, settings, named_files, plan))
            plan("writing the report")
            write_report(folder, outcome.comparison, job.figures)
            if outputs.figures:
                plan("drawing the pictures")
                outcome = replace(outcome, without_figures=draw_if_possible(folder, figures=job.figures))
    if outputs.json_file is not None:
        with atomic_write(outputs.json_file) as file:
            file.write(to_json(document(outcome.comparison)).encode())
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


def _expected_seconds(job: ComparisonJob, outputs: Outputs) -> list[float]:
    """Of each step that is announced, roughly, for progress bars."""
    reading = [reading_seconds(path) for path in (job.reference, *job.candidates.values())]
    pairs = [reading[0] + seconds for seconds in reading[1:]]
    written = sum(pairs) if outputs.folder is not None else 0.0
    return [*reading, sum(2.0 + 20 * pair for pair in pairs), written, drawing_seconds(len(pairs))]


def _run(job: ComparisonJob, settings: Settings, named_files: list[Path], step: Plan) -> Comparison:
    clouds: dict[str, Cloud | Mesh] = {}
    files: dict[str, InputFile] = {}
    for name, path in {"reference": job.reference, **job.candidates}.items():
        step(f"reading {path}")
        warnings: list[str] = []
        clouds[name] = _read(path, settings, warnings, may_be_mesh=name == "reference")
        files[name] = _input(job, path, warnings)
    others = tuple(_input(job, path, []) for path in named_files)
    said = [text for file in others for text in file.warnings]
    reference, of_reference = clouds.pop("reference"), files.pop("reference")
    of_reference = replace(of_reference, warnings=(*of_reference.warnings, *said))
    candidates = {name: cloud for name, cloud in clouds.items() if isinstance(cloud, Cloud)}
    measured = compare(reference, candidates, settings, on_step=step.within())
    return replace(measured, inputs=Inputs(of_reference, files, others))


def _input(job: ComparisonJob, path: Path, warnings: list[str]) -> InputFile:
    sha256 = digest(path)
    if job.expected.get(str(path), sha256) != sha256:
        warnings.append(f"{path}: the file has changed since the settings were written")
    return InputFile(str(path), sha256, tuple(warnings))


def _read(path: Path, settings: Settings, warnings: list[str], *, may_be_mesh: bool) -> Cloud | Mesh:
    if may_be_mesh and holds_mesh(path):
        return read_mesh(path, on_warning=warnings.append)
    filters: dict[str, Any] = {}
    if path.suffix.lower() in FILTERED:  # a LAS reference may be filtered though the candidates are of another kind
        filters = {"classes": settings.classes, "returns": settings.returns}
    return read_cloud(path, on_warning=warnings.append, **filters)


def _absolute(setting: _Setting) -> _Setting | str:
    """A text that names a file, so that it means the same from any folder."""
    file = named_file(setting)
    if file is None or not isinstance(setting, str):
        return setting
    return f"{setting.partition(':')[0]}:{file.absolute()}"
