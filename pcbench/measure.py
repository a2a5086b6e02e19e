"""All metrics of one aligned pair: values in both directions, floors, area weighting and intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from pcbench import intervals, metrics
from pcbench.neighbors import FloatArray, IntArray
from pcbench.voxels import cell_keys

FORTH, BACK = "candidate_to_reference", "reference_to_candidate"


class Direction(NamedTuple):
    """One-way distances of the queries inside the region, and what they would be without any error (floor)."""

    points: FloatArray  # (M, 3) the queries
    distances: FloatArray  # (M,)
    plane: FloatArray | None  # (M,) signed, to tangent planes of the reference
    floor: FloatArray | None  # (M,)
    floor_plane: FloatArray | None  # (M,)
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
    means = {way: _replicate_means(direction, thresholds, block_weights) for way, direction in ways.items()}
    voxels = {way: cell_keys(direction.points, voxel, corner) for way, direction in ways.items()}
    replicates: dict[str, FloatArray] = {}

    def interval(name: str, samples: FloatArray) -> list[float]:
        replicates[name] = samples
        return intervals.interval(samples)

    def mean_squares(name: str, distances: list[FloatArray | None], floors: list[FloatArray | None]) -> Any:
        none = dict.fromkeys(ways)
        present = {way: values for way, values in zip(ways, distances, strict=True) if values is not None}
        if len(present) < len(ways):  # no normals, no distances to planes
            ci = {**none, "symmetric_max": None}
            return {**none, "symmetric_max": None, "floor": none, "ci": ci, "area_weighted": none}
        squares = {way: np.square(values) for way, values in present.items()}
        mse = {way: float(np.mean(values)) for way, values in squares.items()}
        larger = np.maximum(means[FORTH][name], means[BACK][name])
        return {
            **mse,
            "symmetric_max": max(mse.values()),
            "floor": {
                way: None if floor is None else metrics.mean_square(floor)
                for way, floor in zip(ways, floors, strict=True)
            },
            "ci": {
                **{way: interval(f"{name}/{way}", means[way][name]) for way in ways},
                "symmetric_max": interval(f"{name}/symmetric_max", larger),
            },
            "area_weighted": {way: metrics.area_weighted_mean(squares[way], voxels[way]) for way in ways},
        }

    d1 = mean_squares("d1_mse", [d.distances for d in ways.values()], [d.floor for d in ways.values()])
    d2 = mean_squares("d2_mse", [d.plane for d in ways.values()], [d.floor_plane for d in ways.values()])
    ranks = {way: metrics.percentiles(d.distances) for way, d in ways.items()}
    largest = {way: metrics.one_way_hausdorff(d.distances) for way, d in ways.items()}
    worst = {way: d.points[int(np.argmax(d.distances))] + origin for way, d in ways.items()}
    values = {
        "d1_mse": d1,
        "d1_rms": {way: _root(d1[way]) for way in ways},
        "d2_mse": d2,
        "d2_rms": {way: _root(d2[way]) for way in ways},
        "mean_distance": {
            **{way: float(np.mean(d.distances)) for way, d in ways.items()},
            "floor": {way: _mean(d.floor) for way, d in ways.items()},
            "ci": {way: interval(f"mean_distance/{way}", means[way]["mean_distance"]) for way in ways},
            "area_weighted": {way: metrics.area_weighted_mean(d.distances, voxels[way]) for way, d in ways.items()},
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
                chamfer: interval(f"chamfer/{chamfer}", means[FORTH][mean] + means[BACK][mean])
                for chamfer, mean in (("sum_unsquared", "mean_distance"), ("sum_squared", "d1_mse"))
            },
            "floor": {
                "sum_unsquared": _total(_mean(d.floor) for d in ways.values()),
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
    means: Mapping[str, Mapping[str, FloatArray]],
    threshold: float,
    replicates: dict[str, FloatArray],
) -> dict[str, Any]:
    score = metrics.fscore(ways[FORTH].distances, ways[BACK].distances, threshold)
    precision, recall = (means[way][f"within/{threshold!r}"] for way in (FORTH, BACK))
    both = np.array([metrics.harmonic_mean(p, r) for p, r in zip(precision, recall, strict=True)])
    replicates[f"fscore/{threshold!r}"] = both
    named = {"precision": precision, "recall": recall, "fscore": both}
    return {**score._asdict(), "ci": {name: intervals.interval(samples) for name, samples in named.items()}}


def _replicate_means(direction: Direction, thresholds: tuple[float, ...], weights: FloatArray) -> dict[str, FloatArray]:
    """Every mean of one direction in every replicate, (R,) each."""
    per_point = {"mean_distance": direction.distances, "d1_mse": np.square(direction.distances)}
    if direction.plane is not None:
        per_point["d2_mse"] = np.square(direction.plane)
    for threshold in thresholds:
        per_point[f"within/{threshold!r}"] = (direction.distances <= threshold).astype(np.float64)
    return intervals.replicate_means(direction.blocks, per_point, weights)


def _mean(values: FloatArray | None) -> float | None:
    return None if values is None else float(np.mean(values))


def _root(value: float | None) -> float | None:
    return None if value is None else float(np.sqrt(value))


def _total(values: Iterable[float | None]) -> float | None:
    total = 0.0
    for value in values:
        if value is None:
            return None
        total += value
    return total
