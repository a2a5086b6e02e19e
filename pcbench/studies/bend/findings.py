"""What solutions of one scene say about a bend: against the truth, against the first, and which setting did it."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation import Deformation, deform
from pcbench.errors import Notice, PcbenchError, recorded
from pcbench.geometry.cameras import Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.progress import Step

FACTORS = {
    "images": (
        "the choice of images",
        {"half": "every second", "oblique": "with oblique ones", "nadir": "nadir alone"},
    ),
    "focal": ("the focal length", {"true": "at its true value", "free": "solved for", "guessed": "not known"}),
    "distortion": ("the lens distortion", {"true": "at its true value", "zero": "left at zero", "free": "solved for"}),
    "control": ("control points", {"True": "with them", "False": "without them"}),
}
MEASURING_S = 5.0  # that one solution takes, roughly, for progress bars
_TOGETHER = 0.5  # rank correlation
_GRID = 24  # pixels that intrinsics are compared at, along each side


@dataclass(frozen=True)
class Variant:
    """Settings of one solution.

    Args:
        name: in words.
        images: nadir, half (every second of them), oblique (these too) or all.
        focal: true (and fixed), free (from the true one) or guessed (free, and nothing is known of the lens).
        distortion: true (and fixed), zero (and fixed) or free.
        control: whether control points are held fast.
    """

    name: str
    images: str
    focal: str
    distortion: str
    control: bool

    @property
    def factors(self) -> dict[str, str]:
        return {factor: str(getattr(self, factor)) for factor in FACTORS}


@dataclass(frozen=True, eq=False)
class Solution:
    """What became of a variant: a cloud near the truth and the solved intrinsics, or why there is none.

    Args:
        given, registered: images.
        cloud: in the truth's coordinates, without a unit: its scale was fitted, and another one is no deformation.
            Perhaps with the attribute `reprojection_error`.
        failure: one line where there is no cloud.
    """

    variant: Variant
    given: int
    registered: int = 0
    cloud: Cloud | None = None
    intrinsics: Intrinsics | None = None
    notes: tuple[str, ...] = ()
    failure: str = ""


def findings(
    solutions: Sequence[Solution],
    truth: Cloud,
    intrinsics: Intrinsics,
    seed: int = 0,
    step: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """`rows`, one a solution, and `sentences` on the cause, as experiment.json holds them.

    Args:
        truth: the true surface.
        intrinsics: the true ones.
        seed: of the folds of the cross-validation.
    """
    first: tuple[str, Cloud] | None = None
    rows = []
    for number, solution in enumerate(solutions, 1):
        step(Step(f"measuring {solution.variant.name}", MEASURING_S, MEASURING_S * (len(solutions) - number)))
        row: dict[str, Any] = {
            "name": solution.variant.name,
            "factors": solution.variant.factors,
            "images_given": solution.given,
            "images": solution.registered,
            "failure": solution.failure or None,
            "notes": list(solution.notes),
            **dict.fromkeys(("points", "reprojection_error", "lens", "lens_error_px", "truth", "mutual", "cells")),
        }
        if solution.cloud is not None:
            row["points"] = len(solution.cloud)
            errors = solution.cloud.attributes.get("reprojection_error")
            row["reprojection_error"] = None if errors is None else float(np.mean(errors))
            if (k := solution.intrinsics) is not None:
                row["lens"] = intrinsics_values(k)
                row["lens_error_px"] = intrinsics_error(k, intrinsics)
            found, placed = _deformation(truth, solution.cloud, "similarity", seed)
            row["truth"] = _summary(found)
            if found.field is not None:
                row["cells"] = np.column_stack([found.field.places, found.field.vertical, found.field.sigma]).tolist()
            if first is None:
                first = solution.variant.name, placed
            else:
                # Sparse points that a dome moves by metres have no neighbours to register them by anew.
                against, earlier = first
                row["mutual"] = {
                    "against": against,
                    **_summary(_deformation(earlier, placed, "none", seed)[0]),
                }
        rows.append(row)
    return {"rows": rows, "sentences": list(explain(rows, truth.unit or ""))}


def intrinsics_error(intrinsics: Intrinsics, truth: Intrinsics) -> float:
    """RMS in pixels, over the image, of what intrinsics do wrong beyond a wrong focal length: images of a flat scene
    from above do not tell that from another height.
    """
    middles = (np.arange(_GRID) + 0.5) / _GRID
    u, v = np.meshgrid(truth.width * middles, truth.height * middles)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    ours, true = intrinsics.directions(pixels)[:, :2], truth.directions(pixels)[:, :2]
    scale = float((ours * true).sum() / np.square(ours).sum())
    return truth.fx * float(np.sqrt(np.square(scale * ours - true).sum(axis=1).mean()))


def explain(rows: Sequence[Mapping[str, Any]], unit: str) -> Iterator[str]:
    """Sentences on what bends the scene, from the rows of `findings` alone."""
    known = [row for row in rows if row["truth"] is not None and row["truth"]["rms"] is not None]
    if not known:
        yield "No solution could be judged."
        return
    if not any(row["truth"]["verdict"] == "non-affine" for row in known):
        open_ = [row["name"] for row in known if row["truth"]["verdict"] == "undecided"]
        if open_:
            yield f"Whether solutions are bent is undecided: {', '.join(map(repr, open_))}."
        else:
            yield "No solution is bent beyond what noise would do."
        return
    changes = sorted(_changes(known), key=lambda change: -change["by"])
    sure = [change for change in changes if change["sure"]]
    if not sure:
        yield "Solutions are bent, but no two that differ in one setting differ by more than their intervals."
        return
    main = sure[0]
    words, values = FACTORS[main["factor"]]
    names = [values.get(row["factors"][main["factor"]], row["factors"][main["factor"]]) for row in main["rows"]]
    sizes = [_size(row["truth"], unit) for row in main["rows"]]
    yield (
        f"The cause is {words}: {names[0]}, the cloud is bent by {sizes[0]} RMS; {names[1]}, by {sizes[1]},"
        f" all else equal ({main['rows'][0]['name']!r} against {main['rows'][1]['name']!r})."
    )
    for factor, (words, _) in FACTORS.items():
        own = [change for change in changes if change["factor"] == factor]
        if factor != main["factor"] and own:
            yield (
                f"Changing {words} alone changes the bend by at most {own[0]['by']:.3g} {unit} RMS".rstrip()
                + f" ({own[0]['rows'][0]['name']!r} against {own[0]['rows'][1]['name']!r})."
            )
    yield from _shape(main["rows"][0], unit)
    yield from _intrinsics_words(known)
    yield from _mutual_words(known, unit)


def table(document: Mapping[str, Any]) -> Iterator[list[str]]:
    """The rows as texts, a header first."""
    yield ["", "images", "points", "error px", "lens px", "verdict", "bend RMS [95 %]", "detectable", "to the first"]
    for row in document["rows"]:
        images = f"{row['images']}/{row['images_given']}"
        if row["truth"] is None:
            yield [row["name"], images, "", "", "", f"failed: {row['failure']}", "", "", ""]
            continue
        mutual = row["mutual"]
        yield [
            row["name"],
            images,
            f"{row['points']:,}",
            _number(row["reprojection_error"]),
            _number(row["lens_error_px"]),
            row["truth"]["verdict"],
            _size(row["truth"], ""),
            _number(row["truth"]["detectable"]),
            "" if mutual is None else f"{mutual['verdict']}, {_number(mutual['rms'])}",
        ]


def csv_text(document: Mapping[str, Any]) -> str:
    """The rows of a document as CSV, a line each."""
    lines = []
    for row in document["rows"]:
        values = {**{k: row[k] for k in ("name", "images_given", "images", "points", "reprojection_error")}}
        values |= row["factors"]
        values |= {"focal_px": (row["lens"] or {}).get("fx"), "lens_error_px": row["lens_error_px"]}
        for which in ("truth", "mutual"):
            found = row[which] or {}
            low, high = found.get("ci") or (None, None)
            values |= {f"{which}_{key}": found.get(key) for key in ("verdict", "model", "rms")}
            values |= {f"{which}_low": low, f"{which}_high": high, f"{which}_detectable": found.get("detectable")}
        lines.append({**values, "failure": row["failure"]})
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(lines[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def intrinsics_values(k: Intrinsics) -> dict[str, Any]:
    """Intrinsics as JSON holds them."""
    return {"fx": k.fx, "fy": k.fy, "distortion": list(k.distortion), "size": [k.width, k.height]}


def _deformation(reference: Cloud, candidate: Cloud, method: str, seed: int) -> tuple[Deformation, Cloud]:
    """The verdict, and the candidate as it was registered."""
    try:
        registration, found = deform(reference, candidate, method, seed=seed)
    except PcbenchError as error:
        return Deformation.unanswered(Notice("not-registered", recorded(error))), candidate
    return found, candidate.transformed(registration.T_reference_candidate)


def _summary(found: Deformation) -> dict[str, Any]:
    """What a row keeps of a verdict, as JSON holds it."""
    size, growth = found.amplitude, found.growth
    return {
        "verdict": found.verdict,
        "model": found.model,
        "rms": None if size is None else size.rms,
        "ci": None if size is None else list(size.ci),
        "p_value": found.p_value,
        "detectable": found.minimum_detectable_rms,
        "growth": None if growth is None else asdict(growth),
        "warnings": [str(notice) for notice in found.warnings],
    }


def _changes(rows: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """Pairs of rows that differ in one factor, the more bent one first, and by how much."""
    for pair in combinations(rows, 2):
        differ = [f for f in FACTORS if pair[0]["factors"][f] != pair[1]["factors"][f]]
        if len(differ) == 1:
            worse, better = sorted(pair, key=lambda row: -row["truth"]["rms"])
            sure = worse["truth"]["verdict"] == "non-affine" and worse["truth"]["ci"][0] > better["truth"]["ci"][1]
            by = worse["truth"]["rms"] - better["truth"]["rms"]
            yield {"factor": differ[0], "rows": (worse, better), "by": by, "sure": sure}


def _shape(row: Mapping[str, Any], unit: str) -> Iterator[str]:
    """Is it a dome or a bowl? By the vertical displacement in the middle and at the edge."""
    growth = (row["truth"]["growth"] or {}).get("with_distance")
    if growth is None:
        return
    inner, outer = growth["profile"][0], growth["profile"][-1]
    fall = inner["mean"] - outer["mean"]
    if abs(fall) > inner["null"] + outer["null"]:
        shape, side = ("dome", "below") if fall > 0 else ("bowl", "above")
        yield (
            f"It is a {shape}: {outer['at']:.0f} {unit} from the centre the surface lies {abs(fall):.3g} {unit} {side}"
            f" where it should be against the middle ({row['name']!r})."
        ).replace("  ", " ")


def _intrinsics_words(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """How the bend goes with the error of the intrinsics: Spearman's rank correlation."""
    pairs = np.array([[r["lens_error_px"], r["truth"]["rms"]] for r in rows if r["lens_error_px"] is not None])
    if len(pairs) < 4:
        return
    a, b = (_ranks(column) for column in pairs.T)
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return
    rho = float(np.corrcoef(a, b)[0, 1])
    words = "go together" if rho >= _TOGETHER else "do not go together"
    yield f"Bend and error of the solved lens {words}: rank correlation {rho:.2f} over {len(pairs)} solutions."


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of each value; equal ones share theirs."""
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: NDArray[np.float64] = (np.cumsum(counts) - 0.5 * counts)[which]
    return ranks


def _mutual_words(rows: Sequence[Mapping[str, Any]], unit: str) -> Iterator[str]:
    """The observation: two solutions of the same images that no affine motion brings together."""
    bent = [row for row in rows if row["mutual"] is not None and row["mutual"]["verdict"] == "non-affine"]
    named = {row["name"]: row for row in rows}
    same = [
        row
        for row in bent
        if row["mutual"]["against"] in named
        and row["factors"]["images"] == named[row["mutual"]["against"]]["factors"]["images"]
    ]
    if same:
        worst = max(same, key=lambda row: row["mutual"]["rms"])
        first = named[worst["mutual"]["against"]]
        errors = [_number(row["reprojection_error"]) for row in (first, worst)]
        yield (
            f"Solutions of the same images differ by {_size(worst['mutual'], unit)} RMS that no affine motion explains,"
            f" with reprojection errors of {errors[0]} and {errors[1]} px ({first['name']!r} and {worst['name']!r})."
        )


def _size(values: Mapping[str, Any], unit: str) -> str:
    if values["rms"] is None:
        return "–"
    return f"{values['rms']:.3g} [{values['ci'][0]:.3g}, {values['ci'][1]:.3g}] {unit}".rstrip()


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
