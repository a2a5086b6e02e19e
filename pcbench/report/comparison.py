"""The comparison that users get: the measured one, with the files its clouds came from, that can be saved and shown."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.splats import filter_splats, splat_model
from pcbench.io import CloudLike, is_path
from pcbench.measure import comparison, results
from pcbench.measure.settings import Settings, with_changes
from pcbench.progress import Plan
from pcbench.report import plot
from pcbench.report.figures import Figures
from pcbench.report.folder import report_folder, write_report
from pcbench.report.inputs import InputFile, Inputs, SourcedComparison
from pcbench.report.names import names_of
from pcbench.report.reading import named_files, read_candidate, read_reference
from pcbench.report.table import html


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(SourcedComparison):
    """A reference, its candidates, and the differences between them. `comparison["a"]` is the candidate named a.

    Attributes:
        inputs: the files that the clouds came from; None where one came from memory.
    """

    @classmethod
    def of(cls, measured: results.CandidateComparisons, inputs: Inputs | None = None) -> Comparison:
        return cls(measured.settings, measured.reference, measured.candidates, measured.differences, inputs)

    def save(self, folder: str | Path, *, figures: bool | Figures = True) -> None:
        """Write a report: comparison.json, metrics.csv, table.md, deviation clouds, matrices and pictures.

        Args:
            folder: is made; an older report in it is replaced, anything else in it is refused.
            figures: whether pictures are drawn, or how they look.

        Pictures that cannot be drawn are warned about: the numbers are delivered all the same.

        Raises:
            InputError: the folder holds something else, or an input of the comparison; or a candidate's name cannot be
                part of file names.
            OSError: the folder cannot be written.
        """
        with report_folder(Path(folder), keep=[] if self.inputs is None else self.inputs.paths()) as scratch:
            look = figures if isinstance(figures, Figures) else Figures()
            write_report(scratch, self, look)
            problem = plot.draw_if_possible(scratch, figures=look) if figures else None
        if problem is not None:
            warnings.warn(problem, stacklevel=2)

    def _repr_html_(self) -> str:
        """The table, for notebooks."""
        return html(self)


def compare(
    reference: Mesh | CloudLike,
    candidates: Sequence[CloudLike] | Mapping[str, Cloud] | Mapping[str, Any] | CloudLike,
    settings: Settings | None = None,
    *,
    on_step: Callable[[str], None] | None = None,
    **changed: Any,
) -> Comparison:
    """Compare candidate clouds with a reference: register, measure both ways, map, and say whether they are bent.

    Args:
        reference: a cloud, an (N, 3) array, a mesh, which is sampled by area with its faces' normals, or the path of a
            file with a cloud or a mesh.
        candidates: one cloud, (N, 3) array or path, several, or several by name. Files have the name of their stem.
        settings: see `pcbench.Settings`.
        on_step: called with a few words before every step that takes time.
        changed: settings by name, in place of those of `settings`: `compare(a, b, register="similarity", seed=1)`.

    Readers' warnings are given by `warnings.warn`, and kept in the `inputs` of the result.

    Raises:
        InputError: a file, a cloud, a setting or a region is not usable.
        RegistrationError: a candidate does not overlap the reference.
    """
    compared = compare_inputs(reference, candidates, with_changes(settings, changed), on_step or (lambda _: None))
    for file in () if compared.inputs is None else compared.inputs.all():
        for text in file.warnings:
            warnings.warn(text, stacklevel=2)
    return compared


def compare_inputs(
    reference: Mesh | CloudLike,
    candidates: Sequence[CloudLike] | Mapping[str, Cloud] | Mapping[str, Any] | CloudLike,
    settings: Settings,
    step: Callable[[str], None],
) -> Comparison:
    """`compare` that leaves the readers' warnings in the result."""
    files: dict[str, InputFile] = {}
    of_reference, of_settings = None, named_files(settings)
    if isinstance(reference, str | os.PathLike):
        step(f"reading {reference}")
        reference, of_reference = read_reference(Path(reference), settings)
    named = _named(candidates)
    for name, given in named.items():
        if is_path(given):
            step(f"reading {given}")
            named[name], files[name] = read_candidate(Path(given), settings)
    kept, named = _without_faint_splats(reference, named, settings)
    within = step.within() if isinstance(step, Plan) else step
    measured = comparison.compare(kept, named, settings, on_step=within)
    whole = of_reference is not None and files.keys() == named.keys()
    return Comparison.of(measured, Inputs(of_reference, files, of_settings) if of_reference and whole else None)


def _without_faint_splats(reference: Any, candidates: dict[str, Any], settings: Settings) -> tuple[Any, dict[str, Any]]:
    """The clouds, those that are models of Gaussian splats as the settings filter them.

    Raises:
        InputError: none is one, or nothing is left of one.
    """
    limits = settings.min_opacity, settings.max_axis
    if limits == (None, None):
        return reference, candidates
    if not any(_is_splat_model(cloud) for cloud in (reference, *candidates.values())):
        raise InputError("a least opacity and a largest axis filter Gaussian splats: none of the clouds is a model")

    def kept(name: str, cloud: Any) -> Any:
        try:
            return filter_splats(cloud, *limits) if _is_splat_model(cloud) else cloud
        except InputError as error:
            raise InputError(f"{name}: {error}") from error

    return kept("the reference", reference), {name: kept(name, cloud) for name, cloud in candidates.items()}


def _is_splat_model(cloud: Any) -> bool:
    return isinstance(cloud, Cloud) and splat_model(cloud) is not None


def _named(candidates: Any) -> dict[str, Any]:
    """Candidates by name: as given, else the file's, else by their number."""
    if isinstance(candidates, Mapping):
        return dict(candidates)
    if isinstance(candidates, Cloud | np.ndarray) or is_path(candidates):
        candidates = [candidates]
    if not isinstance(candidates, Sequence):
        raise InputError(f"expected one or several clouds as candidates, got {type(candidates).__name__}")
    stems = iter(names_of([Path(given) for given in candidates if is_path(given)]))
    names = [next(stems) if is_path(given) else f"candidate_{k}" for k, given in enumerate(candidates, 1)]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise InputError(f"two candidates are called {twice[0]!r}: give them by name, as {{'name': cloud, ...}}")
    return dict(zip(names, candidates, strict=True))
