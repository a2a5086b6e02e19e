"""`report.html`: the content of a comparison's page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.deformation import Deformation
from pcbench.geometry.arrays import even_rows
from pcbench.measure.results import Candidate
from pcbench.measure.wording import pluralize
from pcbench.report.answer import answer
from pcbench.report.checked import check_point_rows
from pcbench.report.colors import DIVERGING, SEQUENTIAL, SERIES
from pcbench.report.html.budget import bars, change_rows, legend
from pcbench.report.html.charts import charts
from pcbench.report.html.layers import Layer, layers
from pcbench.report.html.metrics_table import MAX_ACROSS, columns_of, main_rows
from pcbench.report.html.packing import rounded
from pcbench.report.html.places import Place, worst_places
from pcbench.report.html.template import InputRow, Opening, Origin, one_line_each, render, script_json, source
from pcbench.report.html.tiles import TileMaps, tile_maps
from pcbench.report.inputs import FinishedComparison
from pcbench.report.notes import deformation_sentence, details, remarks, warnings
from pcbench.report.plot.views import SceneAxes, scene_axes
from pcbench.report.scalars import scalar_of
from pcbench.report.table import lines
from pcbench.report.viewing import ViewingCameras
from pcbench.report.words import UNKNOWN, interval_text, join_words, length, printable, title

SCRIPTS = ("decode", "camera", "lines", "panes", "webgl", "painter", "scene", "controls", "main")
_MAX_ARROWS = 2000  # of a candidate's displacement field
_MAX_CAMERAS = 500


def page(comparison: FinishedComparison, provenance: Mapping[str, Any], color_range: float | None = None) -> str:
    """Return `report.html` of a comparison.

    Args:
        comparison: the comparison.
        provenance: version, commit, command and time, see `pcbench.report.document.provenance`.
        color_range: the end of the colour ranges, if the user sets it.
    """
    axes = scene_axes(comparison.candidates[0].completeness.points, comparison.cameras)
    clouds, places = layers(comparison, color_range, axes), worst_places(comparison)
    tiles = tile_maps(comparison, color_range, axes)
    view = _view(comparison, axes, clouds, places, tiles)
    main, is_wide = main_rows(comparison), len(comparison) > MAX_ACROSS
    opening = Opening(
        "Point cloud comparison",
        _heading(comparison),
        title(comparison),
        answer(comparison),
        list(warnings(comparison)),
        list(remarks(comparison)),
    )
    repeat = None if comparison.inputs is None else "pcbench compare --settings settings.json"
    return render(
        "page.html",
        opening,
        Origin(provenance, repeat, _inputs(comparison)),
        script="\n".join(source(f"viewer/{name}.js") for name in SCRIPTS) if clouds else "",
        names=[printable(c.name) for c in comparison],
        unit=comparison.reference.unit,
        rows=main,
        columns=columns_of(main),
        is_wide=is_wide,
        has_best=any(cell.is_best for row in main for pair in row.cells for cell in pair),
        all_rows=lines(comparison),
        details=one_line_each(details(comparison))[len(comparison) :],  # those of single candidates have a section
        bars=bars(comparison, is_wide=is_wide),
        legend=legend(),
        motions=_motions(comparison),
        changes=change_rows(comparison),
        layers=clouds,
        shown=_shown(clouds),
        charts=charts(comparison),
        deformations=_deformations(comparison),
        check_points=check_point_rows(comparison),
        places=places,
        data=script_json(view),
        tiles=tiles,
        has_arrows=bool(view["arrows"]),
        has_cameras=bool(view["cameras"]),
        scalar_labels=_scalar_labels(clouds),
    )


def _heading(comparison: FinishedComparison) -> str:
    names = [printable(c.name) for c in comparison]
    inputs = comparison.inputs
    reference = "the reference" if inputs is None else printable(Path(inputs.reference.path).name)
    return f"{join_words(names, 4)} against {reference}"


def _motions(comparison: FinishedComparison) -> str:
    """Return under which poses the motions remain."""
    keeps_pose = [c.registration.keeps_pose for c in comparison]
    if all(keeps_pose):
        return "under the given pose"
    return "under the pose in use" if any(keeps_pose) else "after registration"


def _shown(clouds: list[Layer]) -> str:
    """Return how many points of each cloud are shown, in words."""
    thinned = [_share_shown(layer) for layer in clouds if layer.head["shown"] < layer.head["total"]]
    if not thinned:
        return "all points of all clouds"
    return "; ".join(thinned + (["all points of the other clouds"] if len(thinned) < len(clouds) else []))


def _share_shown(layer: Layer) -> str:
    head = layer.head
    name = printable(head["name"]) or "reference"
    text = f"{name}: {head['shown']:,} of {pluralize(head['total'], 'point')}"
    if head["is_sample"]:  # how many of the other points lie beyond is unknown
        return f"{text}, a sample with the largest deviations"
    if head["beyond"]:
        share = "all" if head["beyond_shown"] == head["beyond"] else f"{head['beyond_shown']:,} of"
        text += f", with {share} {head['beyond']:,} beyond the legend's limit"
    if head["outside"]:
        text += f"; {head['outside']:,} are far outside the scene and not shown"
    return text


def _scalar_labels(clouds: list[Layer]) -> list[tuple[str, str]]:
    """Return key and label of each scalar that some layer has."""
    keys = dict.fromkeys(scalar["key"] for layer in clouds for scalar in layer.head["scalars"])
    return [(key, scalar_of(key).short_label) for key in keys]


def _view(
    comparison: FinishedComparison, axes: SceneAxes, clouds: list[Layer], places: list[Place], tiles: TileMaps | None
) -> dict[str, Any]:
    """Return what the 3D view reads besides the points."""
    return {
        "unit": comparison.reference.unit or "",
        "axes": axes.rows.tolist(),
        "isWall": axes.is_wall,
        "layers": [layer.head for layer in clouds],
        "sequential": SEQUENTIAL.tolist(),
        "diverging": DIVERGING.tolist(),
        "series": SERIES,
        "places": [vars(place) for place in places],
        "tiles": None if tiles is None else tiles.data(),
        "arrows": [arrows for c in comparison if (arrows := _arrows(c)) is not None],
        **_cameras(comparison.cameras),
    }


def _cameras(cameras: ViewingCameras | None) -> dict[str, Any]:
    """Return the upward direction, and centres and viewing directions of some cameras as [x, y, z, ...], if known."""
    if cameras is None:
        return {"up": None, "cameras": None}
    rows = even_rows(len(cameras.centers), _MAX_CAMERAS)
    centers, directions = (rounded(vectors[rows]) for vectors in (cameras.centers, cameras.directions))
    return {
        "up": None if cameras.up is None else rounded(cameras.up),
        "cameras": {"centers": centers, "directions": directions},
    }


def _arrows(candidate: Candidate) -> dict[str, Any] | None:
    """Return the displacement field of a deformed candidate as [x, y, z, dx, dy, dz, ...]."""
    field, result = candidate.deformation.field, candidate.deformation.assuming_pose()
    if field is None or result.verdict in ("none", "undecided") or not len(field.places):
        return None
    rows = even_rows(len(field.places), _MAX_ARROWS)
    vectors = field.displacements[rows]
    is_known = np.isfinite(vectors).all(axis=1)
    if not is_known.any():
        return None
    values = np.hstack([field.places[rows], vectors])[is_known]
    return {"name": candidate.name, "values": rounded(values)}


def _deformations(comparison: FinishedComparison) -> list[dict[str, Any]]:
    """Return the verdict on each candidate in words, with its numbers."""
    verdicts = []
    for candidate in comparison:
        name = printable(candidate.name)
        sentence = f"{deformation_sentence(comparison, candidate, name)}."
        verdicts.append({"name": name, "sentence": sentence, "facts": _facts(candidate.deformation, comparison)})
    return verdicts


def _facts(deformation: Deformation, comparison: FinishedComparison) -> dict[str, str]:
    """Return the numbers of a verdict by their names; none without a test."""
    if not deformation.is_tested:
        return {}
    unit, size, noise = comparison.reference.unit, deformation.amplitude, deformation.noise
    rms, sigma, pairs = UNKNOWN, UNKNOWN, UNKNOWN
    if size is not None:
        rms = f"{length(size.rms, unit)} {interval_text(size.ci)}"
    if noise is not None:
        sigma, pairs = length(noise.sigma, unit), f"{noise.n_eff:,.0f} of {deformation.pairs or 0:,}"
    return {
        "verdict": f"{deformation.label} ({deformation.model} model)",
        "p-value": _p_value(deformation.p_value),
        "RMS beyond affine": rms,
        "detectable from": UNKNOWN if deformation.label == "undecided" else length(deformation.size_limit, unit),
        "noise": sigma,
        "independent pairs": pairs,
    }


def _p_value(value: float | None) -> str:
    return UNKNOWN if value is None else f"{value:.2g}" if value >= 1e-9 else "< 1e-9"


def _inputs(comparison: FinishedComparison) -> list[InputRow]:
    """Return a row for each input file."""
    inputs = comparison.inputs
    if inputs is None:
        return []
    named = [("reference", inputs.reference), *inputs.candidates.items(), *(("setting", file) for file in inputs.files)]
    return [
        InputRow(
            printable(role),
            printable(str(file.path)),
            file.sha256,
            "" if file.system is None else printable(file.system.describe()),
        )
        for role, file in named
    ]
