"""Pictures of novel views: photograph, rendering and error side by side, one row per view."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.images import ViewScores, absolute_error
from pcbench.report.colors import SEQUENTIAL, Range, robust_maximum
from pcbench.report.figures import Figures, ink
from pcbench.report.plot import Drawer, Picture
from pcbench.report.plot.panels import DPI, save
from pcbench.report.words import join_words
from pcbench.scenes.views import RenderedView, ViewImages
from pcbench.studies.frame.folder import unique_name
from pcbench.studies.views.scores import KIND, ScoredScene, ScoredView

# Draws the pictures of a folder with scores.json.
PICTURES = Drawer(f"{__name__}:pictures", (KIND.document,))

# All sizes are in inches.
_MAX_WIDTH, _MAX_HEIGHT = 4.4, 4.4  # of one picture
_GAP, _CAPTION_HEIGHT, _TOP_MARGIN, _BOTTOM_MARGIN, _RIGHT_MARGIN = 0.12, 0.34, 0.72, 0.14, 0.95
_BAR_WIDTH = 0.16
_MIN_FIGURE_HEIGHT, _MIN_BAR_HEIGHT = 4.2, 1.5  # leave room for the label of the bar
_MASK_COLOR = (150, 150, 150)
_MIN_ERROR_RANGE = 1.0  # grey level of 255; smaller errors are rounding


class _Row(NamedTuple):
    caption: str
    pictures: ViewImages
    error: FloatArray


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the pictures of a folder that `pcbench views` wrote: the worst, median and best view of each scene."""
    study = KIND.read(folder)
    return {name: _picture(scene, look) for name, scene in _scenes_by_file_name(study.scenes).items()}


def _picture(scene: ScoredScene, look: Figures) -> Picture:
    def draw(path: Path) -> bool:
        draw_views(select_views(scene), title_of(scene), path, look)
        return True

    return Picture(draw)


def title_of(scene: ScoredScene) -> str:
    """Return the title of a scene's picture: which of its views it shows."""
    kind = "held-out views" if scene.select(test=True) else "training views (none was held out)"
    words = join_words(list(select_views(scene)))
    return f"{scene.views.scene}, {scene.views.method}: {words} by PSNR of {len(_eligible_views(scene))} {kind}"


def select_views(scene: ScoredScene) -> dict[str, ScoredView]:
    """Return the worst, median and best held-out view by PSNR, or training view if none was held out.

    Of an even number of views, the worse of the two in the middle is the median view. Of two views none is: their
    median score is the mean of both.
    """
    ranked = sorted(_eligible_views(scene), key=lambda scored: (scored.scores.psnr, scored.view.name))
    if len(ranked) == 1:
        return {"only": ranked[0]}
    middle = {"median": ranked[(len(ranked) - 1) // 2]} if len(ranked) > 2 else {}
    return {"worst": ranked[0], **middle, "best": ranked[-1]}


def _eligible_views(scene: ScoredScene) -> tuple[ScoredView, ...]:
    return scene.select(test=True) or scene.select(test=False)


def draw_views(views: Mapping[str, ScoredView], title: str, path: Path, look: Figures) -> None:
    """Draw one row per view, with one colour bar for all errors, which ends at the largest 95th percentile.

    Args:
        views: views by label, such as "worst".
        title: title of the picture.
        path: file to write; its suffix selects the format.
        look: range of the colour bar and background.
    """
    rows = [_row(word, scored) for word, scored in views.items()]
    limits = [robust_maximum(row.error[np.isfinite(row.error)]) for row in rows]
    default = Range(0.0, max(*limits, _MIN_ERROR_RANGE), "largest 95th percentile")
    scale = default if look.range is None else Range(0.0, look.range, "range as set")
    figure, axis, color, height = _canvas(rows, look)
    width = 3 * _MAX_WIDTH + 2 * _GAP
    axis.text(0, height - 0.22, title, color=color, fontsize=13, ha="left", va="center", parse_math=False)
    for column, word in enumerate(("photograph", "rendering", "absolute error")):
        middle = column * (_MAX_WIDTH + _GAP) + _MAX_WIDTH / 2
        axis.text(middle, height - 0.54, word, color=color, fontsize=11, ha="center", va="center")
    top = height - _TOP_MARGIN
    for row in rows:
        shown_width, shown_height = _picture_size(row)
        top -= _CAPTION_HEIGHT
        axis.text(0, top + 0.13, row.caption, color=color, fontsize=10, ha="left", va="center", parse_math=False)
        shown = (row.pictures.photograph, row.pictures.rendering, _colors(row.error, scale))
        for column, image in enumerate(shown):
            left = column * (_MAX_WIDTH + _GAP) + 0.5 * (_MAX_WIDTH - shown_width)
            _draw_image(axis, image, left, top - shown_height, shown_width, shown_height)
        top -= shown_height + _GAP
    _draw_color_bar(
        axis, width + 0.16, 0.5 * (height - _TOP_MARGIN - _CAPTION_HEIGHT + _BOTTOM_MARGIN), scale, color, rows
    )
    save(figure, path)


def _row(word: str, scored: ScoredView) -> _Row:
    images = scored.view.read()
    error = absolute_error(images.rendering, images.photograph)
    if images.mask is not None:
        error[~images.mask] = np.nan
    return _Row(f"{word}: {_short_name(scored.view)}, {_scores_text(scored.scores)}", images, error)


def _short_name(view: RenderedView) -> str:
    return view.name if len(view.name) <= 60 else f"…{view.name[-59:]}"


def _scores_text(scores: ViewScores) -> str:
    words = [f"PSNR {scores.psnr:.2f} dB", f"SSIM {scores.ssim:.3f}"]
    more = (("LPIPS", scores.lpips), ("FLIP", scores.flip))
    return ", ".join([*words, *(f"{name} {value:.3f}" for name, value in more if value is not None)])


def _picture_size(row: _Row) -> tuple[float, float]:
    """Return the largest width and height of a picture that fit, in inches."""
    height, width = row.error.shape
    scale = min(_MAX_WIDTH / width, _MAX_HEIGHT / height)
    return width * scale, height * scale


def _canvas(rows: Sequence[_Row], look: Figures) -> tuple[Any, Any, str, float]:
    """Return a figure, axes in inches over all of it, the text colour, and the height above the lower margin."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    ground = look.ground("white")
    height = max(
        _TOP_MARGIN + _BOTTOM_MARGIN + sum(_CAPTION_HEIGHT + _picture_size(row)[1] + _GAP for row in rows),
        _MIN_FIGURE_HEIGHT,
    )
    margin = 0.2
    size = 3 * _MAX_WIDTH + 2 * _GAP + _RIGHT_MARGIN + 2 * margin, height
    figure = Figure(figsize=size, dpi=DPI, facecolor=ground)
    FigureCanvasAgg(figure)
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set_axis_off()
    axis.set(xlim=(-margin, size[0] - margin), ylim=(0, height))
    return figure, axis, ink(ground), height


def _draw_image(axis: Any, image: NDArray[np.uint8], left: float, bottom: float, width: float, height: float) -> None:
    axis.set_autoscale_on(False)
    smaller = width * DPI < image.shape[1]
    extent = (left, left + width, bottom, bottom + height)
    axis.imshow(image, extent=extent, aspect="auto", interpolation="antialiased" if smaller else "nearest")


def _colors(error: FloatArray, scale: Range) -> NDArray[np.uint8]:
    """Return RGB colours of errors (H, W); masked pixels are grey."""
    counts = np.isfinite(error)
    image = np.empty((*error.shape, 3), dtype=np.uint8)
    image[:] = _MASK_COLOR
    image[counts] = scale.colors(error[counts])
    return image


def _draw_color_bar(axis: Any, left: float, middle: float, scale: Range, color: str, rows: Sequence[_Row]) -> None:
    """Draw the colour bar; the arrow at its upper end marks larger errors, which have the same colour."""
    from matplotlib.patches import Polygon
    from matplotlib.ticker import MaxNLocator

    high = float(np.clip(0.8 * sum(_picture_size(row)[1] for row in rows), _MIN_BAR_HEIGHT, 3.6))
    low, top, right = middle - high / 2, middle + high / 2, left + _BAR_WIDTH
    steps = scale.colors(np.linspace(scale.high, scale.low, 256))[:, None]
    axis.imshow(steps, extent=(left, right, low, top), aspect="auto", interpolation="nearest")
    tip = [(right, top), ((left + right) / 2, top + 0.14), (left, top)]
    axis.add_patch(Polygon(tip, facecolor=SEQUENTIAL[-1] / 255, edgecolor="none"))
    axis.add_patch(Polygon([(right, low), *tip, (left, low)], fill=False, edgecolor=color, linewidth=0.8))
    for tick in MaxNLocator(5, steps=(1, 2, 5, 10)).tick_values(scale.low, scale.high):
        if scale.low <= tick <= scale.high:
            y = low + high * (tick - scale.low) / (scale.high - scale.low)
            axis.plot([right, right + 0.05], [y, y], color=color, linewidth=0.8)
            axis.text(right + 0.09, y, f"{tick:g}", color=color, fontsize=9.5, va="center")
    masked = any(row.pictures.mask is not None for row in rows)
    label = "|difference|, mean of channels [levels of 255]\n" + scale.note + ("; grey: masked" * masked)
    axis.text(right + 0.42, middle, label, color=color, fontsize=9, rotation=90, ha="left", va="center")


def _scenes_by_file_name(scenes: Sequence[ScoredScene]) -> dict[str, ScoredScene]:
    """Return scenes by valid file names, numbered if several are equal."""
    named: dict[str, ScoredScene] = {}
    for scene in scenes:
        words = f"{scene.views.scene}_{scene.views.method}"
        named[unique_name(re.sub(r"[^\w.-]+", "_", words).strip("._") or "scene", named)] = scene
    return named
