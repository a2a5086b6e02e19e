"""Deformation of the solutions of one scene, against the truth and each other, and the setting that causes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pcbench.deformation import Deformation, deform
from pcbench.errors import InputError, Notice, RegistrationError, record_error
from pcbench.geometry.cameras import Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.progress import Step
from pcbench.report.markup import csv_text as csv_of
from pcbench.report.words import join_words
from pcbench.studies.bend.results import BendStudy, BendVerdict, Lens, MutualVerdict, SolutionResult, measured_bends
from pcbench.studies.frame.tables import cell

FACTORS = {
    "images": (
        "the choice of images",
        {"half": "every second image", "oblique": "with oblique images", "nadir": "nadir images alone"},
    ),
    "focal": ("the focal length", {"true": "at its true value", "free": "solved for", "guessed": "unknown"}),
    "distortion": ("the lens distortion", {"true": "at its true value", "zero": "fixed at zero", "free": "solved for"}),
    "control": ("control points", {"True": "with them", "False": "without them"}),
}
MEASURE_S = 5.0  # rough duration of measuring a solution, for progress bars
_GRID_SIZE = 24  # pixels along each side at which intrinsics are compared


@dataclass(frozen=True)
class Variant:
    """Settings of one solution.

    Args:
        name: name in words.
        images: `nadir`, `half` (every second nadir image), `oblique` (nadir and oblique) or `all`.
        focal: `true` (fixed), `free` (refined from the true value) or `guessed` (refined from a guess, with an unknown
            lens).
        distortion: `true` (fixed), `zero` (fixed) or `free`.
        control: whether control points are used.
    """

    name: str
    images: str
    focal: str
    distortion: str
    control: bool

    @property
    def factors(self) -> dict[str, str]:
        """Settings by name, as text."""
        return {factor: str(getattr(self, factor)) for factor in FACTORS}


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a variant: a cloud registered to the truth and the solved intrinsics, or the reason for its failure.

    Args:
        variant: settings of the solution.
        images_given: number of images.
        images_registered: number of registered images.
        cloud: cloud in the truth's coordinates, perhaps with the attribute `reprojection_error`. It has no unit: its
            scale was fitted, so that a different scale is no deformation.
        intrinsics: solved intrinsics.
        notes: notes of the reconstructor.
        failure: one line if there is no cloud.
    """

    variant: Variant
    images_given: int
    images_registered: int = 0
    cloud: Cloud | None = None
    intrinsics: Intrinsics | None = None
    notes: tuple[str, ...] = ()
    failure: str = ""


def measure_solutions(
    solutions: Sequence[Solution],
    truth: Cloud,
    intrinsics: Intrinsics,
    seed: int = 0,
    step: Callable[[str], None] = lambda _: None,
) -> tuple[SolutionResult, ...]:
    """Measure the deformation of solutions against the truth and against the first solution.

    Args:
        solutions: results of the variants.
        truth: true surface.
        intrinsics: true intrinsics.
        seed: random seed for the folds of the cross-validation.
        step: progress callback.
    """
    standard: tuple[str, Cloud] | None = None
    rows = []
    for number, solution in enumerate(solutions, 1):
        name, cloud, k = solution.variant.name, solution.cloud, solution.intrinsics
        step(Step(f"measuring {name}", MEASURE_S, MEASURE_S * (len(solutions) - number)))
        row = SolutionResult(
            name,
            solution.variant.factors,
            solution.images_given,
            solution.images_registered,
            failure=solution.failure or None,
            notes=solution.notes,
        )
        if cloud is not None:
            verdict, placed = _measure_deformation(truth, cloud, "similarity", seed)
            mutual = None
            if standard is None:
                standard = name, placed
            else:
                # Both are registered to the truth already. A dome of metres leaves sparse points without matches.
                mutual = MutualVerdict.from_deformation(
                    _measure_deformation(standard[1], placed, "none", seed)[0], against=standard[0]
                )
            errors = cloud.attributes.get("reprojection_error")
            row = replace(
                row,
                points=len(cloud),
                reprojection_error=None if errors is None else float(np.mean(errors)),
                lens=None if k is None else Lens.from_intrinsics(k),
                lens_error_px=None if k is None else intrinsics_error(k, intrinsics),
                truth=BendVerdict.from_deformation(verdict),
                mutual=mutual,
                cells=_cells(verdict),
            )
        rows.append(row)
    return tuple(rows)


def _cells(deformation: Deformation) -> tuple[tuple[float, ...], ...] | None:
    if deformation.field is None:
        return None
    columns = np.column_stack([deformation.field.places, deformation.field.vertical, deformation.field.sigma])
    return tuple(map(tuple, columns.tolist()))


def intrinsics_error(intrinsics: Intrinsics, truth: Intrinsics) -> float:
    """RMS error of intrinsics over the image beyond their focal length, in pixels.

    The focal length is left out because nadir images of a flat scene cannot separate it from the flying height.
    """
    middles = (np.arange(_GRID_SIZE) + 0.5) / _GRID_SIZE
    u, v = np.meshgrid(truth.width * middles, truth.height * middles)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    ours, true = intrinsics.directions(pixels)[:, :2], truth.directions(pixels)[:, :2]
    scale = float((ours * true).sum() / np.square(ours).sum())
    return truth.fx * float(np.sqrt(np.square(scale * ours - true).sum(axis=1).mean()))


def explain(rows: Sequence[SolutionResult], unit: str) -> Iterator[str]:
    """Yield sentences on what deforms the scene, computed from the results.

    The first states the condition if registrations are doubtful. Clouds are aligned by corresponding points before, but
    the registration may slide, and a deformation of many point spacings raises doubts as well.
    """
    sentences = _conclusions(rows, unit)
    first = next(sentences)
    measured = measured_bends(rows)
    if doubtful := [repr(row.name) for row, bend in measured if bend.conditional]:
        if len(doubtful) == 1:
            condition = f"the pose of {doubtful[0]} is right (its registration is doubtful)"
        else:
            some = join_words(doubtful) if len(doubtful) == 2 else f"{len(doubtful)} of {len(measured)} solutions"
            poses = "the poses" if len(doubtful) == len(measured) else f"the poses of {some}"
            condition = f"{poses} are right (the registrations are doubtful)"
        first = f"If {condition}, {first[0].lower()}{first[1:]}"
    yield first
    yield from sentences


def _conclusions(rows: Sequence[SolutionResult], unit: str) -> Iterator[str]:
    measured = measured_bends(rows)
    if not measured:
        yield "No solution could be evaluated."
        return
    if not any(bend.is_bent for _, bend in measured):
        open_ = [row.name for row, bend in measured if bend.verdict == "undecided"]
        if open_:
            yield f"It is undecided whether these solutions are deformed: {', '.join(map(repr, open_))}."
        else:
            yield "No solution is deformed beyond what noise explains."
        return
    changes = [change for change in _bend_changes(rows) if change.is_significant]
    main = max(changes, key=lambda change: change.difference, default=None)
    if main is None:
        yield "Solutions are deformed, but no two that differ in one setting differ by more than their 95 % intervals."
        return
    words, values = FACTORS[main.factor]
    names = [values.get(row.factors[main.factor], row.factors[main.factor]) for row in (main.worse, main.better)]
    sizes = [row.truth.size_text(unit) for row in (main.worse, main.better) if row.truth is not None]
    yield (
        f"The cause is {words}: {names[0]}, the cloud is deformed by {sizes[0]} RMS; {names[1]}, by {sizes[1]},"
        f" all else equal ({main.worse.name!r} against {main.better.name!r})."
    )
    yield from _shape_sentence(main.worse, unit)
    yield from _mutual_sentence(rows, unit)


def table(study: BendStudy) -> Iterator[list[str]]:
    """Yield the results as rows of text, a header first."""
    yield ["", "images", "points", "error px", "lens px", "verdict", "bend RMS [95 %]", "detectable", "to the first"]
    for row in study.rows:
        images = f"{row.images}/{row.images_given}"
        if row.truth is None:
            yield [row.name, images, "", "", "", "failed", "", "", ""]
            continue
        yield [
            row.name,
            images,
            f"{row.points:,}",
            cell(row.reprojection_error),
            cell(row.lens_error_px),
            row.truth.verdict_text,
            row.truth.size_text(),
            cell(row.truth.detectable),
            "" if row.mutual is None else f"{row.mutual.verdict_text}, {cell(row.mutual.rms)}",
        ]


def failures(study: BendStudy) -> Iterator[str]:
    """Yield the reason of each failed solution; solutions with the same reason share a line."""
    names: dict[str, list[str]] = {}
    for row in study.rows:
        if row.failure:
            names.setdefault(row.failure, []).append(repr(row.name))
    for reason, solutions in names.items():
        yield f"{join_words(solutions)} failed: {reason}"


def csv_text(study: BendStudy) -> str:
    """Return the results as CSV, one line per solution."""
    of_bend = ("verdict", "model", "rms", "low", "high", "detectable")
    header = ["name", "images_given", "images", "points", "reprojection_error", "focal", "distortion", "control"]
    header += ["focal_px", "lens_error_px", *(f"{which}_{key}" for which in ("truth", "mutual") for key in of_bend)]
    rows = [
        [
            *(row.name, row.images_given, row.factors["images"], row.points, row.reprojection_error),
            *(row.factors[factor] for factor in ("focal", "distortion", "control")),
            *(None if row.lens is None else row.lens.fx, row.lens_error_px),
            *_bend_cells(row.truth),
            *_bend_cells(row.mutual),
            *(row.failure, row.images),
        ]
        for row in study.rows
    ]
    return csv_of([*header, "failure", "images_registered"], rows)


def _bend_cells(bend: BendVerdict | None) -> tuple[object, ...]:
    if bend is None:
        return (None,) * 6
    low, high = bend.ci or (None, None)
    return bend.verdict, bend.model, bend.rms, low, high, bend.detectable


def _measure_deformation(reference: Cloud, candidate: Cloud, method: str, seed: int) -> tuple[Deformation, Cloud]:
    """Return the verdict and the registered candidate."""
    try:
        registration, deformation = deform(reference, candidate, method, seed=seed)
    except (InputError, RegistrationError) as error:
        return Deformation.undecided_because(Notice("not-registered", record_error(error))), candidate
    return deformation, candidate.transformed(registration.T_reference_candidate)


class _BendChange(NamedTuple):
    """Two solutions that differ in one setting, and how much more the worse one is deformed (RMS)."""

    factor: str
    worse: SolutionResult
    better: SolutionResult
    difference: float
    is_significant: bool  # the worse one is deformed and the 95 % intervals do not overlap


def _bend_changes(rows: Sequence[SolutionResult]) -> Iterator[_BendChange]:
    for pair in combinations(measured_bends(rows), 2):
        differ = [factor for factor in FACTORS if pair[0][0].factors[factor] != pair[1][0].factors[factor]]
        if len(differ) == 1:
            (worse, more), (better, less) = sorted(pair, key=lambda item: -(item[1].rms or 0.0))
            separate = more.ci is not None and less.ci is not None and more.ci[0] > less.ci[1]
            yield _BendChange(
                differ[0], worse, better, (more.rms or 0.0) - (less.rms or 0.0), more.is_bent and separate
            )


def _shape_sentence(row: SolutionResult, unit: str) -> Iterator[str]:
    """Yield whether it is a dome or a bowl, from the vertical displacement in the middle and at the edge."""
    growth = None if row.truth is None or row.truth.growth is None else row.truth.growth.with_distance
    if growth is None:
        return
    inner, outer = growth.profile[0], growth.profile[-1]
    fall = inner.mean - outer.mean
    if abs(fall) > inner.null + outer.null:
        shape, side = ("dome", "low") if fall > 0 else ("bowl", "high")
        yield (
            f"It is a {shape}: {outer.at:.0f} {unit} from the centre the surface is {abs(fall):.3g} {unit} too"
            f" {side}, relative to the middle ({row.name!r})."
        ).replace("  ", " ")


def _mutual_sentence(rows: Sequence[SolutionResult], unit: str) -> Iterator[str]:
    """Yield the largest deformation between two solutions of the same images."""
    named = {row.name: row for row, _ in measured_bends(rows)}
    same = [
        (first, row, row.mutual)
        for row in named.values()
        if row.mutual is not None
        and row.mutual.is_bent
        and (first := named.get(row.mutual.against)) is not None
        and row.factors["images"] == first.factors["images"]
    ]
    if same:
        first, worst, bend = max(same, key=lambda item: item[2].rms or 0.0)
        errors = [cell(row.reprojection_error) for row in (first, worst)]
        yield (
            f"Solutions of the same images differ by {bend.size_text(unit)} RMS beyond any affine motion,"
            f" with reprojection errors of {errors[0]} and {errors[1]} px ({first.name!r} and {worst.name!r})."
        )
