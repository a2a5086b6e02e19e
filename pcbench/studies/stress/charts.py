"""All charts and pictures of the stress study, as files of its folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pcbench.extras import require
from pcbench.report.figures import Figures
from pcbench.report.plot import Drawer, Picture
from pcbench.studies.frame.canvas import FIGURES, chart_pictures, delete_former_charts, save_charts
from pcbench.studies.stress.curves import (
    coverage_chart,
    profile_chart,
    recall_chart,
    severity_charts,
    size_chart,
    speed_chart,
)
from pcbench.studies.stress.grids import basin_chart, matrix_chart, outcome_chart
from pcbench.studies.stress.reconstructors.charts import score_charts
from pcbench.studies.stress.results import DOCUMENT, KIND, StressStudy
from pcbench.studies.stress.subjects import SUBJECTS
from pcbench.studies.stress.worst import draw_worst

# Draws the charts of a study's folder.
PICTURES = Drawer(f"{__name__}:pictures", (DOCUMENT,))


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the charts of a folder that `pcbench stress` wrote."""
    study = KIND.read(folder)
    return chart_pictures(lambda: _charts(study), look)


def draw_charts(study: StressStudy, folder: Path) -> list[Path]:
    """Draw all charts of a study, and pictures of its worst silent failures, into `figures/` of its folder.

    Args:
        study: the study.
        folder: folder of the study, which also has the clouds of the silent failures.

    Returns:
        The written files. Charts without data are not written, and those of an earlier run are deleted.

    Raises:
        MissingExtra: matplotlib is not installed.
        OSError: a file cannot be written.
    """
    require("matplotlib.figure")
    files = save_charts(folder, _charts(study))
    for number, failure in enumerate(study.worst, 1):
        files.append(folder / FIGURES / f"worst_{number}.png")
        draw_worst(study, failure, folder, files[-1])
    delete_former_charts(folder, files)
    return files


def _charts(study: StressStudy) -> Iterator[tuple[str, Any]]:
    """Yield the name and the figure of each chart that has data."""
    for subject in SUBJECTS.values():
        yield from _named(f"outcomes_{subject.name}", outcome_chart(study, subject))
        yield from _named(f"matrix_{subject.name}", matrix_chart(study, subject))
    yield from _named("recall", recall_chart(study))
    for ladder in study.ladders:
        if ladder.is_map:
            yield from _named(f"basin_{ladder.name}", basin_chart(study, ladder))
    yield from _named("profiles", profile_chart(study))
    yield from _named("speed", speed_chart(study))
    yield from _named("sizes", size_chart(study))
    yield from _named("coverage", coverage_chart(study))
    for kind, figure in score_charts(study):
        yield f"scores_{kind}", figure
    for subject in SUBJECTS.values():
        for kind, figure in severity_charts(study, subject):
            yield f"severity_{subject.name}_{kind}", figure


def _named(name: str, figure: Any | None) -> Iterator[tuple[str, Any]]:
    if figure is not None:
        yield name, figure
