"""What a bench says of one cloud: brought onto the reference as its gauge allows, then the whole comparison."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.errors import InputError, recorded
from pcbench.extras import unavailable
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.crop import points_inside
from pcbench.geometry.neighbors import Index
from pcbench.geometry.region_text import parse_region
from pcbench.geometry.regions import Region
from pcbench.geometry.transform import Similarity, format_matrix, robust_similarity
from pcbench.io.files import atomic_write
from pcbench.measure.metrics import harmonic_mean
from pcbench.measure.settings import Settings
from pcbench.plugins import Reconstruction
from pcbench.registration import METHODS, Registration, parse_method
from pcbench.registration.result import UNOBSERVABLE, WEAKLY_OBSERVABLE
from pcbench.report import compare, document
from pcbench.studies.bench.truth import Truth

BY_GAUGE = "gauge"
DEFAULT_PIXELS = (1.0, 2.0, 5.0)  # thresholds by default, in pixels on the ground; the last one heads tables and charts
_DENSITY_NEIGHBORS = 16  # that the density of the reference is taken from


class Alignment(NamedTuple):
    """How a cloud comes onto the reference: `cameras` by a transform that was found by them, else as `compare` has it;
    and what is to be said of it.
    """

    method: str
    transform: Similarity | None = None
    notes: tuple[str, ...] = ()


def choose_alignment(reconstruction: Reconstruction, cameras: Mapping[str, Camera]) -> Alignment:
    """The registration that a cloud's gauge asks for.

    What is in the world of the scene is measured as it stands: where it lies is part of what it claims, and fitting
    would take errors away. A frame of its own is no error; it is brought onto the reference by the centres of its
    cameras, which does not depend on the cloud that is judged. Without them the surfaces decide, from any pose where
    KISS-Matcher is installed. Only an arbitrary gauge gets a scale.
    """
    if reconstruction.gauge == "georeferenced":
        return Alignment("none")
    free_scale = reconstruction.gauge == "arbitrary"
    names = sorted(set(reconstruction.cameras) & set(cameras))
    notes: tuple[str, ...] = ()
    if names:
        found = np.stack([reconstruction.cameras[name].position for name in names])
        true = np.stack([cameras[name].position for name in names])
        try:
            fit = robust_similarity(found, true, with_scale=free_scale)
        except InputError as error:
            notes = (f"not registered by cameras: {recorded(error)}",)
        else:
            errors = np.linalg.norm(fit.apply(found) - true, axis=1)
            spread = f"{np.median(errors):.3g} (median), {errors.max():.3g} (largest)"
            note = f"registered by {len(names)} cameras, with errors of {spread}"
            return Alignment("cameras", fit, (note,))
    fine = "similarity" if free_scale else "icp"
    if why := unavailable("kiss_matcher"):
        return Alignment(fine, None, (*notes, f"`{fine}` starts from where the cloud is: {why}"))
    return Alignment("global-similarity" if free_scale else "global", None, notes)


@dataclass(frozen=True)
class Rules:
    """How every cloud is measured.

    Args:
        register: `gauge`, or one of `pcbench.registration.METHODS` for all.
        crop: see `pcbench.geometry.region_text.parse_region`.
        threshold: of precision, recall and F-score: lengths in the reference's unit, or with `px` in pixels on the
            ground (`Truth.pixel`), several with commas between them; the last one heads tables and charts. None: 1, 2
            and 5 pixels, or times the reference's median spacing where there are no cameras.
    """

    register: str = BY_GAUGE
    crop: str = "none"
    threshold: str | None = None


class Threshold(NamedTuple):
    """In the reference's unit, and in pixels on the ground where it was given so."""

    length: float
    pixels: float | None = None


@dataclass(frozen=True, eq=False)
class EvaluationProtocol:
    """A truth, the rules by which clouds are held against it, and what follows from both.

    Args:
        thresholds: at least one; the last one heads tables and charts.
        region: that is measured; None for all.
        seen: points (M, 3) evenly spread over what the cameras saw in the region; None where that cannot be said.
        seen_spacing: how far apart they are; at most the smallest threshold, but for large scenes.
    """

    truth: Truth
    rules: Rules
    thresholds: tuple[Threshold, ...]
    region: Region | None
    visible_points: FloatArray | None
    visible_spacing: float | None

    @classmethod
    def of(cls, truth: Truth, rules: Rules) -> EvaluationProtocol:
        """Check the rules, and say before anything runs that no cloud could be measured by them.

        Raises:
            InputError: there is no such registration, region or threshold, or the region leaves nothing of the
                reference.
        """
        kind, _, path = rules.register.partition(":")
        names_file = path and kind in ("points", "matrix")
        if not names_file and rules.register not in (BY_GAUGE, *METHODS):
            expected = ", ".join((BY_GAUGE, *METHODS))
            raise InputError(f"unknown registration {rules.register!r}: expected {expected}")
        if names_file:
            parse_method(rules.register)  # which reads the file
        region = parse_region(rules.crop, truth.cloud)
        points_inside(truth.cloud.points, region, rules.crop, "the reference's")
        thresholds = _thresholds(rules.threshold, truth)
        visible = truth.sample_visible(min(t.length for t in thresholds), region)
        return cls(truth, rules, thresholds, region, *(visible or (None, None)))


def _thresholds(text: str | None, truth: Truth) -> tuple[Threshold, ...]:
    if text is None and truth.pixel is not None:
        return tuple(Threshold(n * truth.pixel, n) for n in DEFAULT_PIXELS)
    if text is None:
        if truth.spacing == 0:
            raise InputError("the reference has no two points apart, so no spacing: give --threshold")
        return tuple(Threshold(n * truth.spacing) for n in DEFAULT_PIXELS)
    found = []
    for word in text.split(","):
        number, in_pixels = (word.strip().removesuffix("px"), word.strip().endswith("px"))
        try:
            value = float(number)
        except ValueError:
            value = 0.0
        if not 0 < value < float("inf"):
            raise InputError(f"expected --threshold as lengths, or as pixels (1px,2px,5px), above 0; got {text!r}")
        if in_pixels and truth.pixel is None:
            raise InputError(f"--threshold {text}: the scene has no cameras that see the reference, so no pixels on it")
        found.append(Threshold(value * truth.pixel, value) if in_pixels and truth.pixel else Threshold(value))
    return tuple(found)


@dataclass(frozen=True)
class ThresholdScore:
    """Shares at one threshold.

    Attributes:
        threshold: in the reference's unit; pixels: the same in pixels on the ground, where it was given so.
        precision: of the cloud's points within the threshold of the true surface, or of the reference's points where
            the surface is not known.
        recall: of the reference's points with a point of the cloud within the threshold; fscore: the harmonic mean.
        recall_visible: of the area that the cameras saw, and fscore_visible: precision with that. None where it cannot
            be said.
        precision_floor: what a cloud without errors would have: 1 by the surface, less by points that are far apart.
        recall_floor, recall_visible_floor: what the cloud's own points would have if they had no error: lower where
            they are few, or lie in one place. None where the surface is not known.
    """

    threshold: float
    pixels: float | None
    precision: float
    recall: float
    fscore: float
    recall_visible: float | None
    fscore_visible: float | None
    precision_floor: float
    recall_floor: float | None
    recall_visible_floor: float | None


@dataclass(frozen=True, eq=False)
class Score:
    """What a bench says of one cloud.

    Attributes:
        registration: how it was brought onto the reference.
        accuracy_to: `surface`, where it is known, or `points` of the reference.
        mean_c2r, d1_c2r: mean and mean square of the distances from the cloud to that; mean_r2c, d1_r2c: from the
            reference's points to the cloud.
        mean_c2r_floor, mean_r2c_floor: what clouds without errors would score. None where there is no such thing.
        hausdorff: the largest distance of either direction.
        at: one for each threshold.
        notes: one line each.
        comparison: the whole comparison, as in comparison.json.
    """

    registration: str
    accuracy_to: str
    mean_c2r: float
    mean_c2r_floor: float | None
    mean_r2c: float
    mean_r2c_floor: float | None
    d1_c2r: float
    d1_r2c: float
    hausdorff: float
    threshold_scores: tuple[ThresholdScore, ...]
    notes: tuple[str, ...]
    comparison: dict[str, Any]

    @property
    def chamfer(self) -> float:
        """The sum of the mean distances."""
        return self.mean_c2r + self.mean_r2c

    def row(self) -> dict[str, Any]:
        """For bench.json: the columns of bench.csv, what is at every threshold, and the whole comparison."""
        values = {
            f.name: getattr(self, f.name)
            for f in fields(self)
            if f.name not in ("threshold_scores", "notes", "comparison")
        }
        return {
            **values,
            "chamfer": self.chamfer,
            **asdict(self.threshold_scores[-1]),
            "thresholds": [asdict(at) for at in self.threshold_scores],
            "notes": list(self.notes),
            "comparison": self.comparison,
        }


def score(protocol: EvaluationProtocol, reconstruction: Reconstruction, folder: Path) -> Score:
    """Measure one cloud; writes T.txt, the matrix candidate -> reference, into the folder.

    Raises:
        InputError, RegistrationError: it cannot be measured.
    """
    truth, rules = protocol.truth, protocol.rules
    chosen = (
        choose_alignment(reconstruction, truth.cameras) if rules.register == BY_GAUGE else Alignment(rules.register)
    )
    settings = Settings(
        register=chosen.method if chosen.transform is None else chosen.transform,
        crop=rules.crop,
        thresholds=tuple(t.length for t in protocol.thresholds),
    )
    comparison = compare(truth.cloud, {"cloud": reconstruction.cloud}, settings)
    result = comparison.candidates[0]
    with atomic_write(folder / "T.txt") as file:
        file.write(format_matrix(result.registration.T_reference_candidate).encode())
    metrics = result.metrics
    to_truth, error_free = _distances_to_truth(
        protocol, result.registration.T_local.apply(reconstruction.cloud.points - truth.origin)
    )
    by_surface = error_free is not None
    mean, square, farthest = (
        (float(to_truth.distances.mean()), float(np.square(to_truth.distances).mean()), float(to_truth.distances.max()))
        if by_surface
        else (
            _required(metrics.mean_distance.accuracy.value),
            _required(metrics.d1_mse.accuracy.value),
            metrics.hausdorff.accuracy.largest,
        )
    )
    return Score(
        registration=chosen.method,
        accuracy_to="surface" if by_surface else "points",
        mean_c2r=mean,
        mean_c2r_floor=0.0 if by_surface else metrics.mean_distance.accuracy.floor,
        mean_r2c=_required(metrics.mean_distance.completeness.value),
        mean_r2c_floor=metrics.mean_distance.completeness.floor,
        d1_c2r=square,
        d1_r2c=_required(metrics.d1_mse.completeness.value),
        hausdorff=max(farthest, metrics.hausdorff.completeness.largest),
        threshold_scores=tuple(_threshold_scores(protocol, to_truth, error_free)),
        notes=(
            *chosen.notes,
            *reconstruction.residuals.rmse_lines(reconstruction.cloud.unit),
            *map(str, result.warnings),
            *_registration_notes(result.registration),
        ),
        comparison=document(comparison)["candidates"][0],
    )


class _CloudDistances(NamedTuple):
    """Of a cloud on the reference, minus its origin.

    Attributes:
        points: (N, 3), all of them: completeness is no matter of the region's edge.
        distances: (M,) of those inside the region, to the surface, or to the reference's points.
        spacings: (M,) square roots of the area a point that the reference's points have there.
    """

    points: FloatArray
    distances: FloatArray
    spacings: FloatArray


def _distances_to_truth(protocol: EvaluationProtocol, points: FloatArray) -> tuple[_CloudDistances, FloatArray | None]:
    """Distances of a cloud's points, and where they would be without errors (N, 3): None without the surface."""
    truth = protocol.truth
    local = None if protocol.region is None else protocol.region.shifted(truth.origin)
    inside = np.ones(len(points), dtype=bool) if local is None else local.contains(points)
    if truth.local_surface is not None:
        matches = truth.local_surface.query(points)
        # What is far off would be nowhere, and not at the nearest wall.
        near = matches.distances <= max(t.length for t in protocol.thresholds)
        distances = matches.distances[inside]
        return _CloudDistances(points, distances, np.zeros(len(distances))), matches.closest[near]
    distances, nearest = truth.local_index.query(points[inside])
    others = min(_DENSITY_NEIGHBORS, len(truth.cloud) - 1)
    # The nearest point is one with much room around it: its density is taken from a neighbour, which chance chose.
    places = truth.local_index.query(truth.local_index.points[nearest], k=others + 1).indices[:, -1]
    radii = truth.local_index.query(truth.local_index.points[places], k=others + 1).distances[:, -1]
    # Of k others within r, (k - 1) / (pi r^2) is an unbiased density.
    return _CloudDistances(points, distances, radii * np.sqrt(np.pi / max(1, others - 1))), None


def _threshold_scores(
    protocol: EvaluationProtocol, to_truth: _CloudDistances, error_free: FloatArray | None
) -> Iterator[ThresholdScore]:
    truth, region = protocol.truth, protocol.region
    whole = truth.cloud.points if region is None else truth.cloud.points[region.contains(truth.cloud.points)]
    places = {"recall": whole - truth.origin}
    if protocol.visible_points is not None:
        places["recall_visible"] = protocol.visible_points - truth.origin
    back = {name: _nearest_distances(to_truth.points, at) for name, at in places.items()}
    if error_free is not None:
        back |= {f"{name}_floor": _nearest_distances(error_free, at) for name, at in places.items()}
    for threshold in protocol.thresholds:
        t = threshold.length
        precision = float(np.mean(to_truth.distances <= t))
        shares = {name: float(np.mean(distances <= t)) for name, distances in back.items()}
        seen = shares.get("recall_visible")
        # Random places of a density d have a point within t with probability 1 - exp(-pi d t^2).
        with np.errstate(divide="ignore"):
            chances = -np.expm1(-np.pi * np.square(t / to_truth.spacings))
        yield ThresholdScore(
            threshold=t,
            pixels=threshold.pixels,
            precision=precision,
            recall=shares["recall"],
            fscore=harmonic_mean(precision, shares["recall"]),
            recall_visible=seen,
            fscore_visible=None if seen is None else harmonic_mean(precision, seen),
            precision_floor=float(chances.mean()),
            recall_floor=shares.get("recall_floor"),
            recall_visible_floor=shares.get("recall_visible_floor"),
        )


def _nearest_distances(points: FloatArray, places: FloatArray) -> FloatArray:
    """From places (M, 3) to the nearest of points (N, 3); infinite where there are none."""
    return Index(points).query(places).distances if len(points) else np.full(len(places), np.inf)


def _required(value: float | None) -> float:
    assert value is not None  # distances to points always exist
    return value


def _registration_notes(registration: Registration) -> list[str]:
    """Its warnings. What the geometry does not fix is none where the pose is not from the geometry."""
    left_out = (UNOBSERVABLE, WEAKLY_OBSERVABLE) if registration.converged is None else ()
    return [notice.text for notice in registration.warnings if notice.code not in left_out]
