"""A comparison from files to files: read everything, compare, write; nothing is left unless everything went well."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from pcbench.errors import InputError
from pcbench.io import FILTERED
from pcbench.io.files import atomic_write, check_output, named_file
from pcbench.measure.m3c2 import M3C2Settings
from pcbench.measure.settings import Settings
from pcbench.report.comparison import Comparison, compare_inputs
from pcbench.report.document import document, to_json
from pcbench.report.folder import read_settings, report_folder, write_report
from pcbench.report.inputs import InputFile, Inputs
from pcbench.report.plot import draw_if_possible
from pcbench.report.reading import names_of, paths_in

_Setting = TypeVar("_Setting")


@dataclass(frozen=True)
class ComparisonJob:
    """What to compare. `expected` holds the sha256 of files (by absolute path) that were recorded before."""

    reference: Path
    candidates: dict[str, Path]
    settings: Settings
    expected: dict[str, str]

    @classmethod
    def of(cls, reference: Path, candidates: Sequence[Path], settings: Settings) -> ComparisonJob:
        return cls(reference, dict(zip(names_of(candidates), candidates, strict=True)), settings, {})

    @classmethod
    def recorded(cls, settings_file: Path) -> ComparisonJob:
        """The comparison that a report's settings.json describes."""
        settings, inputs = read_settings(settings_file)
        candidates = {name: Path(file.path) for name, file in inputs.candidates.items()}
        expected = {file.path: file.sha256 for file in inputs.all()}
        return cls(Path(inputs.reference.path), candidates, settings, expected)


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
    if isinstance(settings.m3c2, M3C2Settings):
        settings = replace(settings, m3c2=settings.m3c2.absolute())
    inputs = [job.reference, *job.candidates.values(), *paths_in(settings)]
    if (settings.classes or settings.returns) and not any(p.suffix.lower() in FILTERED for p in inputs):
        raise InputError("--classes and --returns filter LAS files: none of the clouds is one")
    if outputs.json_file is not None:
        check_output(outputs.json_file, inputs)
        if outputs.folder is not None and outputs.json_file.resolve().is_relative_to(outputs.folder.resolve()):
            raise InputError(f"{outputs.json_file}: the report would be there too: write it beside {outputs.folder}")
    if outputs.folder is None:
        outcome = ComparisonOutcome(_run(job, settings, step))
    else:
        with report_folder(outputs.folder, keep=inputs) as folder:
            outcome = ComparisonOutcome(_run(job, settings, step))
            step("writing the report")
            write_report(folder, outcome.comparison)
            if outputs.figures:
                step("drawing the pictures")
                outcome = replace(outcome, without_figures=draw_if_possible(folder))
    if outputs.json_file is not None:
        with atomic_write(outputs.json_file) as file:
            file.write(to_json(document(outcome.comparison)).encode())
    return outcome


def _run(job: ComparisonJob, settings: Settings, step: Callable[[str], None]) -> Comparison:
    measured = compare_inputs(job.reference, job.candidates, settings, step)
    assert measured.inputs is not None  # all come from files
    inputs = measured.inputs
    reference, *files = (_with_change(job, file) for file in (inputs.reference, *inputs.files))
    said = [text for file in files for text in file.warnings]
    reference = replace(reference, warnings=(*reference.warnings, *said))
    candidates = {name: _with_change(job, file) for name, file in inputs.candidates.items()}
    return replace(measured, inputs=Inputs(reference, candidates, tuple(files)))


def _with_change(job: ComparisonJob, file: InputFile) -> InputFile:
    """The file with a warning where it is not the one that was recorded."""
    if job.expected.get(file.path, file.sha256) == file.sha256:
        return file
    return replace(
        file, warnings=(*file.warnings, f"{file.path}: the file has changed since the settings were written")
    )


def _absolute(setting: _Setting) -> _Setting | str:
    """A text that names a file, so that it means the same from any folder."""
    file = named_file(setting)
    if file is None or not isinstance(setting, str):
        return setting
    return f"{setting.partition(':')[0]}:{file.absolute()}"
