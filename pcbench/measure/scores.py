"""All metrics of one aligned pair: values in both directions, floors, area weighting and intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.voxels import Cells, cells
from pcbench.measure import intervals, metrics

FORTH, BACK = "candidate_to_reference", "reference_to_candidate"


class Floor(NamedTuple):
    """What a direction's means would be without any error; None where there is no such thing."""

    mean_distance: float | None = None
    d1_mse: float | None = None
    d2_mse: float | None = None

    @classmethod
    def of(cls, distances: FloatArray, plane: FloatArray | None) -> Floor:
        """From distances (M,) to points and to planes."""
        d2 = None if plane is None else metrics.mean_square(plane)
        return cls(float(np.mean(distances)), metrics.mean_square(distances), d2)


class Direction(NamedTuple):
    """One-way distances of the queries inside the region."""

    points: FloatArray  # (M, 3) the queries
    distances: FloatArray  # (M,)
    plane: FloatArray | None  # (M,) signed, to tangent planes of the reference
    floor: Floor
    blocks: IntArray  # (M,) of the bootstrap


class Measurement(NamedTuple):
    """Metrics as `comparison.json` shows them, and the replicates (R,) of every mean among them."""

    values: dict[str, Any]
    replicates: dict[str, FloatArray]


def measure(
    forth: Direction,
    back: Direction,
    thresholds: tuple[float, ...],
    *,
    block_weights: FloatArray,
    voxel: float,
    corner: FloatArray,
    origin: FloatArray,
) -> Measurement:
    """Measure candidate -> reference (`forth`) and reference -> candidate (`back`).

    Args:
        thresholds: of the F-score.
        block_weights: (R, B) of the bootstrap's replicates.
        voxel, corner: side of the cells that area weighting averages over first, and where (3,) they are counted from.
        origin: (3,) added to the coordinates of the worst points.
    """
    ways = {FORTH: forth, BACK: back}
    means = {
        way: _means(direction, thresholds, block_weights, cells(direction.points, voxel, corner))
        for way, direction in ways.items()
    }
    replicates: dict[str, FloatArray] = {}

    def interval(name: str, samples: FloatArray) -> list[float]:
        replicates[name] = samples
        return intervals.interval(samples)

    def mean_squares(name: str) -> Any:
        none = dict.fromkeys(ways)
        if not all(name in means[way] for way in ways):  # no normals, no distances to planes
            ci = {**none, "symmetric_max": None}
            return {**none, "symmetric_max": None, "floor": none, "ci": ci, "area_weighted": none}
        larger = np.maximum(means[FORTH][name].replicates, means[BACK][name].replicates)
        return {
            **{way: means[way][name].value for way in ways},
            "symmetric_max": max(means[way][name].value for way in ways),
            "floor": {way: getattr(d.floor, name) for way, d in ways.items()},
            "ci": {
                **{way: interval(f"{name}/{way}", means[way][name].replicates) for way in ways},
                "symmetric_max": interval(f"{name}/symmetric_max", larger),
            },
            "area_weighted": {way: means[way][name].area_weighted for way in ways},
        }

    d1, d2 = mean_squares("d1_mse"), mean_squares("d2_mse")
    ranks = {way: metrics.percentiles(d.distances) for way, d in ways.items()}
    largest = {way: metrics.one_way_hausdorff(d.distances) for way, d in ways.items()}
    worst = {way: d.points[int(np.argmax(d.distances))] + origin for way, d in ways.items()}
    values = {
        "d1_mse": d1,
        "d1_rms": {way: _root(d1[way]) for way in ways},
        "d2_mse": d2,
        "d2_rms": {way: _root(d2[way]) for way in ways},
        "mean_distance": {
            **{way: means[way]["mean_distance"].value for way in ways},
            "floor": {way: d.floor.mean_distance for way, d in ways.items()},
            "ci": {way: interval(f"mean_distance/{way}", means[way]["mean_distance"].replicates) for way in ways},
            "area_weighted": {way: means[way]["mean_distance"].area_weighted for way in ways},
        },
        "hausdorff": {
            **largest,
            "symmetric_max": max(largest.values()),
            "p95": {way: ranks[way]["p95"] for way in ways},
            "p99": {way: ranks[way]["p99"] for way in ways},
            "worst_point": {way: [float(v) for v in point] for way, point in worst.items()},
        },
        "chamfer": {
            "sum_unsquared": metrics.chamfer_unsquared(forth.distances, back.distances),
            "sum_squared": metrics.chamfer_squared(forth.distances, back.distances),
            "ci": {
                chamfer: interval(f"chamfer/{chamfer}", means[FORTH][mean].replicates + means[BACK][mean].replicates)
                for chamfer, mean in (("sum_unsquared", "mean_distance"), ("sum_squared", "d1_mse"))
            },
            "floor": {
                "sum_unsquared": _total(d.floor.mean_distance for d in ways.values()),
                "sum_squared": _total(d1["floor"].values()),
            },
        },
        "fscore": [_fscore(ways, means, threshold, replicates) for threshold in thresholds],
        "percentiles": ranks,
    }
    return Measurement(values, replicates)


def value_of(values: Mapping[str, Any], name: str) -> float:
    """The value that a replicate's name ("d1_mse/candidate_to_reference", "fscore/0.1") stands for."""
    metric, _, key = name.partition("/")
    if metric == "fscore":
        return next(float(row["fscore"]) for row in values["fscore"] if repr(row["threshold"]) == key)
    return float(values[metric][key])


def _fscore(
    ways: Mapping[str, Direction],
    means: Mapping[str, Mapping[str, _Mean]],
    threshold: float,
    replicates: dict[str, FloatArray],
) -> dict[str, Any]:
    score = metrics.fscore(ways[FORTH].distances, ways[BACK].distances, threshold)
    precision, recall = (means[way][f"within/{threshold!r}"].replicates for way in (FORTH, BACK))
    both = np.array([metrics.harmonic_mean(p, r) for p, r in zip(precision, recall, strict=True)])
    replicates[f"fscore/{threshold!r}"] = both
    named = {"precision": precision, "recall": recall, "fscore": both}
    return {**score._asdict(), "ci": {name: intervals.interval(samples) for name, samples in named.items()}}


class _Mean(NamedTuple):
    """Of one quantity of one direction."""

    value: float
    replicates: FloatArray  # (R,)
    area_weighted: float | None = None


def _means(direction: Direction, thresholds: tuple[float, ...], weights: FloatArray, voxels: Cells) -> dict[str, _Mean]:
    """Every mean of one direction; one quantity after the other, so that only one takes room."""
    count = intervals.replicate_sums(direction.blocks, None, weights)

    def mean(values: FloatArray) -> _Mean:
        return _Mean(float(np.mean(values)), intervals.replicate_sums(direction.blocks, values, weights) / count)

    def spread(values: FloatArray) -> _Mean:
        return mean(values)._replace(area_weighted=metrics.area_weighted_mean(values, voxels))

    means = {"mean_distance": spread(direction.distances), "d1_mse": spread(np.square(direction.distances))}
    if direction.plane is not None:
        means["d2_mse"] = spread(np.square(direction.plane))
    for threshold in thresholds:
        means[f"within/{threshold!r}"] = mean((direction.distances <= threshold).astype(np.float64))
    return means


def _root(value: float | None) -> float | None:
    return None if value is None else float(np.sqrt(value))


def _total(values: Iterable[float | None]) -> float | None:
    total = 0.0
    for value in values:
        if value is None:
            return None
        total += value
    return total
