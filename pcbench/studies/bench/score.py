"""Evaluate one cloud of a bench: register it as its gauge allows, then compare it with the reference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.comparison.run import compare
from pcbench.errors import InputError, record_error
from pcbench.extras import import_problem
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.crop import points_inside
from pcbench.geometry.neighbors import Index
from pcbench.geometry.region_text import as_region, region_file
from pcbench.geometry.regions import Region
from pcbench.geometry.transform import Similarity, format_matrix, robust_similarity
from pcbench.measure.metrics import harmonic_mean
from pcbench.measure.settings import Settings
from pcbench.plugins import Reconstruction
from pcbench.registration import METHODS, Method, Registration, parse_method
from pcbench.registration.result import UNOBSERVABLE, WEAKLY_OBSERVABLE
from pcbench.report import document
from pcbench.scratch import atomic_write
from pcbench.studies.bench.results import Score, ThresholdScore
from pcbench.studies.bench.truth import Truth

BY_GAUGE = "gauge"
DEFAULT_PIXELS = (1.0, 2.0, 5.0)  # default thresholds, in pixels on the ground; tables and charts use the last one
_DENSITY_NEIGHBORS = 16  # neighbours for the local density of the reference


class Alignment(NamedTuple):
    """How a cloud is registered to the reference.

    Args:
        method: `cameras` if `transform` was fitted to the cameras, otherwise a method of `compare`.
        transform: cloud to reference coordinates, or None.
        notes: one line each.
    """

    method: str
    transform: Similarity | None = None
    notes: tuple[str, ...] = ()


def choose_alignment(reconstruction: Reconstruction, cameras: Mapping[str, Camera]) -> Alignment:
    """Choose the registration that a cloud's gauge allows.

    A georeferenced cloud is measured where it is: its position is part of the result, and a fit would hide its errors.
    A cloud in a separate frame is registered to the reference by its camera centres, which is independent of the
    evaluated geometry. Without cameras it is registered by its surface, from any initial pose if KISS-Matcher is
    installed. Only a cloud of arbitrary gauge gets a scale.

    Args:
        reconstruction: cloud and cameras to register.
        cameras: true cameras by image name.
    """
    if reconstruction.gauge == "georeferenced":
        return Alignment("none")
    free_scale = reconstruction.gauge == "arbitrary"
    names = sorted(set(reconstruction.cameras) & set(cameras))
    notes: tuple[str, ...] = ()
    if names:
        solved = np.stack([reconstruction.cameras[name].position for name in names])
        true = np.stack([cameras[name].position for name in names])
        try:
            fit = robust_similarity(solved, true, with_scale=free_scale)
        except InputError as error:
            notes = (f"cannot register by cameras: {record_error(error)}",)
        else:
            errors = np.linalg.norm(fit.apply(solved) - true, axis=1)
            spread = f"{np.median(errors):.3g} (median) and {errors.max():.3g} (largest)"
            note = f"registered by {len(names)} cameras; position errors: {spread}, in the reference's unit"
            return Alignment("cameras", fit, (note,))
    fine = "similarity" if free_scale else "icp"
    if why := import_problem("kiss_matcher"):
        return Alignment(fine, None, (*notes, f"`{fine}` starts from the cloud's current pose: {why}"))
    return Alignment("global-similarity" if free_scale else "global", None, notes)


@dataclass(frozen=True)
class Rules:
    """Rules by which each cloud is measured.

    Args:
        register: `gauge`, or one of `pcbench.registration.METHODS` for all clouds.
        crop: region as text, see `pcbench.geometry.region_text.parse_region`.
        threshold: distance thresholds of precision, recall and F-score, separated by commas: lengths in the reference's
            unit, or pixels on the ground (`Truth.pixel`) with the suffix `px`. Tables and charts use the last one.
            None: 1, 2 and 5 pixels, or multiples of the reference's median spacing if there are no cameras.
    """

    register: str = BY_GAUGE
    crop: str = "none"
    threshold: str | None = None


class Threshold(NamedTuple):
    """A distance threshold in the reference's unit, and in pixels on the ground if it was specified in pixels."""

    length: float
    pixels: float | None = None


@dataclass(frozen=True, eq=False)
class EvaluationProtocol:
    """The truth with the rules of the evaluation, and quantities that are derived from both.

    Args:
        truth: reference of the evaluation.
        method: registration method for all clouds; None: by the gauge of each.
        thresholds: at least one; tables and charts use the last one.
        region: evaluated region; None for everything.
        visible_points: (M, 3) points evenly spread over the part of the region that the cameras saw; None if unknown.
        visible_spacing: their spacing, at most the smallest threshold except in very large scenes.
    """

    truth: Truth
    method: Method | None
    thresholds: tuple[Threshold, ...]
    region: Region | None
    visible_points: FloatArray | None
    visible_spacing: float | None

    @classmethod
    def from_rules(cls, truth: Truth, rules: Rules) -> EvaluationProtocol:
        """Check the rules against the truth before any run starts.

        Raises:
            InputError: the registration, region or threshold does not exist, or the region holds no point of the
                reference.
        """
        if ":" not in rules.register and rules.register not in (BY_GAUGE, *METHODS):
            expected = ", ".join((BY_GAUGE, *METHODS))
            raise InputError(f"expected a registration method ({expected}), got {rules.register!r}")
        method = None if rules.register == BY_GAUGE else parse_method(rules.register)
        region = as_region(rules.crop, truth.cloud)
        points_inside(truth.cloud.points, region, rules.crop, "the reference's")
        thresholds = _thresholds(rules.threshold, truth)
        visible = truth.sample_visible(min(t.length for t in thresholds), region)
        return cls(truth, method, thresholds, region, *(visible or (None, None)))

    @property
    def files(self) -> list[Path]:
        """Files with matrices, point pairs and polygons that the rules name."""
        method = () if self.method is None else self.method.files
        return [*method, *filter(None, [None if self.region is None else region_file(self.region)])]


def _thresholds(text: str | None, truth: Truth) -> tuple[Threshold, ...]:
    if text is None and truth.pixel is not None:
        return tuple(Threshold(n * truth.pixel, n) for n in DEFAULT_PIXELS)
    if text is None:
        if truth.spacing == 0:
            raise InputError("the median spacing of the reference is 0, so it gives no threshold; set --threshold")
        return tuple(Threshold(n * truth.spacing) for n in DEFAULT_PIXELS)
    thresholds = []
    for word in text.split(","):
        number, in_pixels = (word.strip().removesuffix("px"), word.strip().endswith("px"))
        try:
            value = float(number)
        except ValueError:
            value = 0.0
        if not 0 < value < float("inf"):
            raise InputError(f"expected --threshold as lengths above 0, or as pixels (1px,2px,5px), got {text!r}")
        if in_pixels and truth.pixel is None:
            raise InputError(
                f"--threshold {text}: no camera of the scene sees the reference, so pixels have no size on it"
            )
        thresholds.append(Threshold(value * truth.pixel, value) if in_pixels and truth.pixel else Threshold(value))
    return tuple(thresholds)


def score(protocol: EvaluationProtocol, reconstruction: Reconstruction, folder: Path) -> Score:
    """Evaluate one cloud and write the matrix candidate -> reference to T.txt.

    Args:
        protocol: truth and rules.
        reconstruction: cloud and cameras to evaluate.
        folder: folder for T.txt.

    Raises:
        InputError: the cloud cannot be measured.
        RegistrationError: the cloud cannot be registered.
    """
    truth, method = protocol.truth, protocol.method
    chosen = choose_alignment(reconstruction, truth.cameras) if method is None else Alignment(method.text)
    settings = Settings(
        register=chosen.transform or method or chosen.method,
        crop=protocol.region or "none",
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
            _require(metrics.mean_distance.accuracy.value),
            _require(metrics.d1_mse.accuracy.value),
            metrics.hausdorff.accuracy.largest,
        )
    )
    thresholds = tuple(_threshold_scores(protocol, to_truth, error_free))
    mean_back = _require(metrics.mean_distance.completeness.value)
    return Score(
        **vars(thresholds[-1]),
        registration=chosen.method,
        accuracy_to="surface" if by_surface else "points",
        mean_c2r=mean,
        mean_c2r_floor=0.0 if by_surface else metrics.mean_distance.accuracy.floor,
        mean_r2c=mean_back,
        mean_r2c_floor=metrics.mean_distance.completeness.floor,
        d1_c2r=square,
        d1_r2c=_require(metrics.d1_mse.completeness.value),
        chamfer=mean + mean_back,
        hausdorff=max(farthest, metrics.hausdorff.completeness.largest),
        thresholds=thresholds,
        notes=(
            *chosen.notes,
            *reconstruction.residuals.rmse_lines(reconstruction.cloud.unit),
            *map(str, result.warnings),
            *_registration_notes(result.registration),
        ),
        comparison=document(comparison)["candidates"][0],
    )


class _CloudDistances(NamedTuple):
    """Distances from a cloud to the truth, in coordinates minus the reference's origin.

    Attributes:
        points: (N, 3) all points of the cloud, also those outside the region, because they can complete its edge.
        distances: (M,) of the points inside the region, to the surface or to the reference's points.
        spacings: (M,) local spacing of the reference's points: square root of the area per point.
    """

    points: FloatArray
    distances: FloatArray
    spacings: FloatArray


def _distances_to_truth(protocol: EvaluationProtocol, points: FloatArray) -> tuple[_CloudDistances, FloatArray | None]:
    """Return the distances to the truth, and the points (N, 3) moved onto the surface, or None without a surface."""
    truth = protocol.truth
    local = None if protocol.region is None else protocol.region.shifted(truth.origin)
    inside = np.ones(len(points), dtype=bool) if local is None else local.contains(points)
    if truth.local_surface is not None:
        matches = truth.local_surface.query(points)
        # Outliers are left out: without errors they would not exist, rather than lie on the nearest wall.
        near = matches.distances <= max(t.length for t in protocol.thresholds)
        distances = matches.distances[inside]
        return _CloudDistances(points, distances, np.zeros(len(distances))), matches.closest[near]
    distances, nearest = truth.local_index.query(points[inside])
    others = min(_DENSITY_NEIGHBORS, len(truth.cloud) - 1)
    # The nearest point is biased towards sparse places. Its k-th neighbour is not, so the density is measured there.
    places = truth.local_index.query(truth.local_index.points[nearest], k=others + 1).indices[:, -1]
    radii = truth.local_index.query(truth.local_index.points[places], k=others + 1).distances[:, -1]
    # With the k-th of k neighbours at distance r, (k - 1) / (pi r^2) is an unbiased estimate of the density.
    return _CloudDistances(points, distances, radii * np.sqrt(np.pi / max(1, others - 1))), None


def _threshold_scores(
    protocol: EvaluationProtocol, to_truth: _CloudDistances, error_free: FloatArray | None
) -> Iterator[ThresholdScore]:
    truth, region = protocol.truth, protocol.region
    whole = truth.cloud.points if region is None else truth.cloud.points[region.contains(truth.cloud.points)]
    places = {"recall": whole - truth.origin}
    if protocol.visible_points is not None:
        places["recall_visible"] = protocol.visible_points - truth.origin
    back = {name: _nearest_distances(to_truth.points, points) for name, points in places.items()}
    if error_free is not None:
        back |= {f"{name}_floor": _nearest_distances(error_free, points) for name, points in places.items()}
    for threshold in protocol.thresholds:
        t = threshold.length
        precision = float(np.mean(to_truth.distances <= t))
        shares = {name: float(np.mean(distances <= t)) for name, distances in back.items()}
        seen = shares.get("recall_visible")
        # Points at random positions with density d have one within t with probability 1 - exp(-pi d t^2).
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
    """Distances from positions (M, 3) to the nearest of points (N, 3); infinite if there are no points."""
    return Index(points).query(places).distances if len(points) else np.full(len(places), np.inf)


def _require(value: float | None) -> float:
    assert value is not None  # distances to points always exist
    return value


def _registration_notes(registration: Registration) -> list[str]:
    """Warnings of a registration, without those on observability if the pose was not found from the geometry."""
    left_out = (UNOBSERVABLE, WEAKLY_OBSERVABLE) if registration.converged is None else ()
    return [notice.text for notice in registration.warnings if notice.code not in left_out]
