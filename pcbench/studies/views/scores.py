"""Scores of rendered views, per view and per scene, and the files that store them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.errors import InputError, Notice
from pcbench.io.json_values import from_json
from pcbench.measure.images import ViewScores
from pcbench.measure.perceptual import Perceptual
from pcbench.progress import Step
from pcbench.report.markup import csv_text
from pcbench.scenes.views import RenderedView, RenderedViews, read_views
from pcbench.studies.frame.folder import StudyKind

_EXPECTED_VIEW_S = 0.3  # rough duration of measuring a view, for progress bars


class ScoredView(NamedTuple):
    """A view and its scores."""

    view: RenderedView
    scores: ViewScores


@dataclass(frozen=True)
class ScoredScene:
    """Rendered views of a scene and their scores, in the order of `views.views`."""

    views: RenderedViews
    scores: tuple[ViewScores, ...]

    def select(self, *, test: bool) -> tuple[ScoredView, ...]:
        """Return the held-out views (`test`), or the training views."""
        both = zip(self.views.views, self.scores, strict=True)
        return tuple(ScoredView(view, scores) for view, scores in both if view.is_test == test)

    def mean(self, *, test: bool) -> ViewScores | None:
        """Return the mean scores of the held-out or the training views; None if there are none.

        Views without a score, for example because they are masked entirely, are left out.
        """
        chosen = [scored.scores for scored in self.select(test=test)]
        return mean_scores(chosen) if chosen else None

    def standard_error(self) -> float | None:
        """Return the standard error of the mean PSNR of the held-out views, in dB; None for fewer than two blocks.

        It is computed from the means of blocks, because the errors of neighbouring views are correlated.
        """
        blocks: dict[int, list[float]] = {}
        for scored in self.select(test=True):
            if math.isfinite(scored.scores.psnr):
                blocks.setdefault(scored.view.block or 0, []).append(scored.scores.psnr)
        means = [sum(block) / len(block) for block in blocks.values()]
        return float(np.std(means, ddof=1) / math.sqrt(len(means))) if len(means) > 1 else None


@dataclass(frozen=True)
class ViewStudy:
    """Scores of several scenes.

    Attributes:
        scenes: scored scenes.
        notes: what could not be measured, and why.
    """

    scenes: tuple[ScoredScene, ...]
    notes: tuple[Notice, ...] = ()


def score_views(
    folders: Sequence[Path], on_step: Callable[[str], None] = lambda _: None, perceptual: Perceptual | None = None
) -> ViewStudy:
    """Measure the rendered views of folders or workspaces.

    Args:
        folders: folders or workspaces, as for `pcbench.scenes.views.read_views`.
        on_step: progress callback.
        perceptual: LPIPS and FLIP of other packages; None uses those that are installed.

    Raises:
        InputError: a folder holds no rendered views, or a picture cannot be decoded.
        MissingExtra: Pillow is not installed.
    """
    read = [read_views(folder) for folder in folders]
    measured = perceptual or Perceptual.find_available()
    left = sum(len(views.views) for views in read)
    scenes = []
    for views in read:
        scores = []
        for view in views.views:
            left -= 1
            on_step(Step(f"measuring the views of {views.scene}", _EXPECTED_VIEW_S, _EXPECTED_VIEW_S * left))
            pictures = view.read()
            scores.append(measured.scores(pictures.rendering, pictures.photograph, pictures.mask))
        scenes.append(ScoredScene(views, tuple(scores)))
    return ViewStudy(tuple(scenes), (*measured.missing, *_masked_view_notices(scenes)))


def _masked_view_notices(scenes: Iterable[ScoredScene]) -> Iterable[Notice]:
    for scene in scenes:
        if bare := [v.name for v, s in zip(scene.views.views, scene.scores, strict=True) if math.isnan(s.ssim)]:
            yield Notice(
                "masked-views",
                f"{scene.views.scene}: {len(bare)} views such as {bare[0]} have no SSIM, because their masks leave no"
                " complete window; the mean SSIM omits them",
            )


class _ViewsKind(StudyKind[ViewStudy]):
    """The document has names and scores of views; their files are found through their folder."""

    def values(self, study: ViewStudy) -> dict[str, Any]:
        notes = [{"code": note.code, "text": note.text} for note in study.notes]
        return {"schema": self.schema, "scenes": [_scene_values(scene) for scene in study.scenes], "notes": notes}

    def read(self, folder: Path) -> ViewStudy:
        values = self.read_values(folder)
        scenes = []
        for row in values["scenes"]:
            views = read_views(Path(row["folder"]))
            scores = {view["name"]: _scores(view) for view in row["views"]}
            if missing := [view.name for view in views.views if view.name not in scores]:
                raise InputError(
                    f"{folder / self.document}: expected scores of {missing[0]} too; views were added in {views.folder}"
                )
            scenes.append(ScoredScene(views, tuple(scores[view.name] for view in views.views)))
        return ViewStudy(tuple(scenes), tuple(from_json(Notice, note) for note in values["notes"]))


KIND = _ViewsKind("views", "scores.json", "pcbench.view-scores/1", ViewStudy, "views.md")


def _scene_values(scene: ScoredScene) -> dict[str, Any]:
    views = scene.views
    rows = [
        {"name": view.name, "block": view.block, **_score_values(scores)}
        for view, scores in zip(views.views, scene.scores, strict=True)
    ]
    means = {
        key: None
        if (mean := scene.mean(test=test)) is None
        else {"views": len(scene.select(test=test)), **_score_values(mean)}
        for key, test in (("train", False), ("test", True))
    }
    named = {"scene": views.scene, "method": views.method, "split": views.split, "folder": str(views.folder.absolute())}
    return {**named, **means, "test_psnr_standard_error": scene.standard_error(), "views": rows}


def _score_values(scores: ViewScores) -> dict[str, float | str | None]:
    """Return scores as JSON values; infinity, for which JSON has no number, as "inf"."""
    return {key: "inf" if value == math.inf else value for key, value in asdict(scores).items()}


def _scores(row: dict[str, Any]) -> ViewScores:
    def number(key: str) -> float:
        return math.nan if row[key] is None else float(row[key])

    optional = (None if row[key] is None else float(row[key]) for key in ("lpips", "flip"))
    return ViewScores(number("psnr"), number("ssim"), *optional)


def scores_csv(study: ViewStudy) -> str:
    """Return the scores as CSV, one row per view."""
    rows = [
        (
            *(scene.views.scene, scene.views.method, view.name, "test" if view.is_test else "train", view.block),
            *(None if value is None else repr(value) for value in astuple(scores)),
        )
        for scene in study.scenes
        for view, scores in zip(scene.views.views, scene.scores, strict=True)
    ]
    return csv_text(["scene", "method", "view", "set", "block", *(item.name for item in fields(ViewScores))], rows)


def mean_scores(scores: Sequence[ViewScores]) -> ViewScores:
    """Return the means of at least one view's scores, without NaN; LPIPS and FLIP are None unless all have them."""

    def mean(values: Iterable[float]) -> float:
        finite = [value for value in values if not math.isnan(value)]
        return sum(finite) / len(finite) if finite else math.nan

    lpips = [s.lpips for s in scores if s.lpips is not None]
    flip = [s.flip for s in scores if s.flip is not None]
    return ViewScores(
        mean(s.psnr for s in scores),
        mean(s.ssim for s in scores),
        mean(lpips) if len(lpips) == len(scores) else None,
        mean(flip) if len(flip) == len(scores) else None,
    )
