"""The scores of rendered views, of each and of a scene, and the files that keep them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.errors import InputError, Notice
from pcbench.io.files import read_json
from pcbench.measure.images import ViewScores
from pcbench.measure.perceptual import Perceptual
from pcbench.progress import Step
from pcbench.report import to_json
from pcbench.report.markup import csv_text
from pcbench.scenes.views import RenderedView, RenderedViews, read_views
from pcbench.studies.folder import write_pages

SCHEMA = "pcbench.view-scores/1"
DOCUMENT = "scores.json"
_EXPECTED_VIEW_S = 0.3  # that a view takes, roughly, for progress bars


class ScoredView(NamedTuple):
    """A view and what was measured of it."""

    view: RenderedView
    scores: ViewScores


@dataclass(frozen=True)
class ScoredScene:
    """A scene's rendered views and their scores, in the order of `views.views`."""

    views: RenderedViews
    scores: tuple[ViewScores, ...]

    def select(self, *, test: bool) -> tuple[ScoredView, ...]:
        """Those that were held out, or those that were trained on."""
        both = zip(self.views.views, self.scores, strict=True)
        return tuple(ScoredView(view, scores) for view, scores in both if view.is_test == test)

    def mean(self, *, test: bool) -> ViewScores | None:
        """Means over the views that were held out, or trained on; None where there are none. A view of which nothing
        counts is left out."""
        found = [scored.scores for scored in self.select(test=test)]
        return mean_scores(found) if found else None

    def standard_error(self) -> float | None:
        """Of the mean PSNR of held-out views, dB: from the spread of the means of their blocks, because views that are
        near each other are well or badly made together. None for fewer than two blocks.
        """
        blocks: dict[int, list[float]] = {}
        for scored in self.select(test=True):
            if math.isfinite(scored.scores.psnr):
                blocks.setdefault(scored.view.block or 0, []).append(scored.scores.psnr)
        means = [sum(block) / len(block) for block in blocks.values()]
        return float(np.std(means, ddof=1) / math.sqrt(len(means))) if len(means) > 1 else None


@dataclass(frozen=True)
class ViewStudy:
    """What was measured of several scenes.

    Attributes:
        notes: what could not be measured, and why.
    """

    scenes: tuple[ScoredScene, ...]
    notes: tuple[Notice, ...] = ()


def score_views(
    folders: Sequence[Path], on_step: Callable[[str], None] = lambda _: None, perceptual: Perceptual | None = None
) -> ViewStudy:
    """Measure the rendered views of folders or workspaces that `pcbench.scenes.views` knows.

    Args:
        perceptual: metrics of other packages; None: those that are here.

    Raises:
        InputError: a folder holds no rendered views, or a picture cannot be decoded.
        MissingExtra: Pillow is not installed.
    """
    read = [read_views(folder) for folder in folders]
    measured = perceptual or Perceptual.here()
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
                f"{scene.views.scene}: {len(bare)} views such as {bare[0]} count nowhere in a whole window of SSIM,"
                " whose mean is without them",
            )


def write_scores(out: Path, study: ViewStudy) -> None:
    """Write `scores.json`, which `read_scores` reads, and `scores.csv`, a row a view.

    Raises:
        OSError: a file cannot be written.
    """
    notes = [{"code": note.code, "text": note.text} for note in study.notes]
    document = {"schema": SCHEMA, "scenes": [_scene_values(scene) for scene in study.scenes], "notes": notes}
    write_pages(out, {"scores.csv": _csv(study), DOCUMENT: to_json(document)})


def read_scores(out: Path) -> ViewStudy:
    """What `write_scores` wrote.

    Raises:
        InputError: it is something else, or its pictures are gone.
    """
    document = read_json(out / DOCUMENT)
    if document.get("schema") != SCHEMA:
        raise InputError(f"{out / DOCUMENT}: expected the schema {SCHEMA}, got {document.get('schema')!r}")
    scenes = []
    for row in document["scenes"]:
        views = read_views(Path(row["folder"]))
        scores = {view["name"]: _scores(view) for view in row["views"]}
        if missing := [view.name for view in views.views if view.name not in scores]:
            raise InputError(f"{out / DOCUMENT}: {views.folder} has other views by now, such as {missing[0]}")
        scenes.append(ScoredScene(views, tuple(scores[view.name] for view in views.views)))
    return ViewStudy(tuple(scenes), tuple(Notice(**note) for note in document["notes"]))


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
    """Infinity, which JSON has no number for, as a word."""
    return {key: "inf" if value == math.inf else value for key, value in scores._asdict().items()}


def _scores(row: dict[str, Any]) -> ViewScores:
    def number(key: str) -> float:
        return math.nan if row[key] is None else float(row[key])

    optional = (None if row[key] is None else float(row[key]) for key in ("lpips", "flip"))
    return ViewScores(number("psnr"), number("ssim"), *optional)


def _csv(study: ViewStudy) -> str:
    rows = [
        (
            *(scene.views.scene, scene.views.method, view.name, "test" if view.is_test else "train", view.block),
            *(None if value is None else repr(value) for value in scores),
        )
        for scene in study.scenes
        for view, scores in zip(scene.views.views, scene.scores, strict=True)
    ]
    return csv_text(["scene", "method", "view", "set", "block", *ViewScores._fields], rows)


def mean_scores(scores: Sequence[ViewScores]) -> ViewScores:
    """Means of at least one; those that are NaN are left out, and LPIPS and FLIP are None unless all are known."""

    def mean(values: Iterable[float]) -> float:
        known = [value for value in values if not math.isnan(value)]
        return sum(known) / len(known) if known else math.nan

    lpips = [s.lpips for s in scores if s.lpips is not None]
    flip = [s.flip for s in scores if s.flip is not None]
    return ViewScores(
        mean(s.psnr for s in scores),
        mean(s.ssim for s in scores),
        mean(lpips) if len(lpips) == len(scores) else None,
        mean(flip) if len(flip) == len(scores) else None,
    )
