"""Rank maps without a reference by `pcbench quality`, on ladders of noise and of drift with known errors.

    python benchmarks/quality.py --seeds 3

A building of six rooms is scanned from 24 places along a corridor and back. A ladder has ten levels of the noise of the
points, or of the drift of the poses (a random walk in position and heading). The error of a map is the root mean square
distance of its points from the true surfaces after the best rigid motion of the poses. For each number, the table has
the Spearman correlation with the error over the levels of each ladder. Beside ours stand the formulas of MapEval
(Cloud_Map_Evaluation): mean map entropy and mean plane variance, evaluated directly by numpy and scipy. The second
table has the recovery of known values: noise, distance of double walls, area of voids, offset of strips, and tilt.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np
from measure import limit_threads, setting

from pcbench.measure.quality.numbers import quality_numbers
from pcbench.measure.quality.quality import CloudData, measure_quality
from pcbench.measure.quality.settings import QualitySettings

LEVELS = 10
NOISE = np.geomspace(0.003, 0.06, LEVELS)  # m
DRIFT = np.geomspace(0.004, 0.12, LEVELS)  # m per step of the walk, and a hundredth of it in radians
SCAN_NOISE = 0.008  # m, on the ladder of drift
RADIUS, MIN_NEIGHBORS = 0.3, 12
ROOMS = [(x, y) for x in (0, 6, 12) for y in (0, 7)]  # corners of rooms of 5.8 m x 5 m beside a corridor of 2 m
NAMES = ("noise", "thickness", "map_entropy", "plane_variance")


def surfaces():
    """Return rectangles as (corner, edge, edge): walls, floors and ceilings of the rooms and of the corridor."""
    rectangles = []
    for x, y, width, depth in [*((x, y, 5.8, 5.0) for x, y in ROOMS), (0.0, 5.0, 17.8, 2.0)]:
        for z in (0.0, 2.6):
            rectangles.append(((x, y, z), (width, 0, 0), (0, depth, 0)))
        for corner, edge in (
            ((x, y), (width, 0)),
            ((x, y + depth), (width, 0)),
            ((x, y), (0, depth)),
            ((x + width, y), (0, depth)),
        ):
            rectangles.append(((*corner, 0.0), (*edge, 0), (0, 0, 2.6)))
    return [tuple(np.array(part, dtype=float) for part in each) for each in rectangles]


def scan_map(rng, noise, drift, points=150_000):
    """Return the points of a map (N, 3) and its error."""
    shapes = surfaces()
    areas = np.array([np.linalg.norm(np.cross(u, v)) for _, u, v in shapes])
    places = np.column_stack(
        [np.concatenate([np.linspace(0.5, 17.3, 12), np.linspace(17.3, 0.5, 12)]), np.full(24, 6.0), np.full(24, 1.3)]
    )
    offsets = np.cumsum(rng.normal(0, drift, (24, 3)) * [1, 1, 0.3], axis=0)
    headings = np.cumsum(rng.normal(0, drift / 100, 24))
    offsets, headings = offsets - offsets.mean(axis=0), headings - headings.mean()
    which = rng.choice(len(shapes), 4 * points, p=areas / areas.sum())
    s, t = rng.random((2, 4 * points, 1))
    corners, first, second = (np.array([shape[k] for shape in shapes])[which] for k in range(3))
    true = corners + s * first + t * second
    normals = np.cross(first, second)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    scan = rng.integers(0, 24, len(true))
    seen = np.linalg.norm(true - places[scan], axis=1) < 7.0
    true, normals, scan = true[seen][:points], normals[seen][:points], scan[seen][:points]
    noisy = true + rng.normal(0, noise, (len(true), 1)) * normals
    away = noisy - places[scan]
    cos, sin = np.cos(headings[scan]), np.sin(headings[scan])
    turned = np.column_stack([cos * away[:, 0] - sin * away[:, 1], sin * away[:, 0] + cos * away[:, 1], away[:, 2]])
    moved = turned + places[scan] + offsets[scan]
    error = np.einsum("ni,ni->n", moved - true, normals)
    return moved, float(np.sqrt(np.mean(error**2)))


def peer(points, radius, least, rng):
    """Return mean map entropy and mean plane variance by MapEval's formulas, at 4,000 points, and CPU seconds."""
    from scipy.spatial import cKDTree

    start = time.process_time()
    tree = cKDTree(points)
    rows = rng.choice(len(points), min(4_000, len(points)), replace=False)
    entropies, variances = [], []
    for near in tree.query_ball_point(points[rows], radius):
        if len(near) < least:
            continue
        covariance = np.cov(points[near].T)
        determinant = np.linalg.det(2 * math.pi * math.e * covariance)
        if determinant > 0:
            entropies.append(0.5 * math.log(determinant))
            variances.append(np.linalg.eigvalsh(covariance)[0])
    return float(np.mean(entropies)), float(np.mean(variances)), time.process_time() - start


def ladder(levels, seed, *, is_drift):
    """Return the errors (L,) and the numbers (L, K) of the maps of a ladder, and CPU seconds."""
    errors, rows, seconds = [], [], np.zeros(2)
    settings = QualitySettings(radius=RADIUS, min_neighbors=MIN_NEIGHBORS)
    for level, amount in enumerate(levels):
        rng = np.random.default_rng(1000 * seed + level if not is_drift else seed)
        points, error = scan_map(rng, SCAN_NOISE if is_drift else amount, amount if is_drift else 0.0)
        start = time.process_time()
        quality, _ = measure_quality(CloudData(points, {}), settings)
        seconds[0] += time.process_time() - start
        numbers = quality_numbers(quality, "m")
        entropy, variance, cpu = peer(points, RADIUS, MIN_NEIGHBORS, np.random.default_rng(0))
        seconds[1] += cpu
        found = quality.double_walls
        rows.append(
            [
                *((numbers[name].value or math.nan) for name in NAMES),
                entropy,
                variance,
                len(found.walls),
                numbers["double_wall_separation"].value or 0.0,
            ]
        )
        errors.append(error)
    return np.array(errors), np.array(rows), seconds


def spearman(first, second):
    """Return the Spearman correlation of two rows of values, NaN if one is missing."""
    from scipy.stats import spearmanr

    return float(spearmanr(first, second).statistic)


def recoveries(seed):
    """Yield the name, the truth and the recovered value of known properties of made clouds."""
    rng = np.random.default_rng(seed)
    settings = QualitySettings(seed=seed)

    def numbers(points, **attributes):
        return quality_numbers(measure_quality(CloudData(points, attributes), settings)[0], "m")

    def floor(count, size, noise):
        return np.column_stack([rng.uniform(0, size, (count, 2)), rng.normal(0, noise, count)])

    for noise in (0.005, 0.02, 0.06):
        yield f"noise {noise} m", noise, numbers(floor(60_000, 10, noise))["noise"].value
    for gap in (0.05, 0.1, 0.2):
        wall = np.column_stack(
            [
                rng.uniform(0, 8, 40_000),
                rng.normal(0, 0.008, 40_000) + gap * (rng.random(40_000) < 0.5),
                rng.uniform(0, 3, 40_000),
            ]
        )
        yield (
            f"double wall {gap} m",
            gap,
            numbers(np.vstack([wall, floor(40_000, 8, 0.008)]))["double_wall_separation"].value,
        )
    for radius in (6.0, 10.0, 16.0):
        ground = floor(80_000, 200, 0.03)
        ground = ground[np.hypot(*(ground[:, :2] - 90).T) > radius]
        yield f"void of radius {radius:g} m", math.pi * radius**2, numbers(ground)["void_area"].value
    for offset in (0.02, 0.06, 0.15):
        ground = floor(60_000, 100, 0.03)
        strip = rng.integers(1, 3, len(ground))
        ground[:, 2] += 0.1 * ground[:, 0] + offset * (strip == 2)
        yield f"strip offset {offset} m", offset, numbers(ground, point_source_id=strip)["strip_dz"].value
    for tilt in (0.3, 1.0, 3.0):
        points, _ = scan_map(rng, 0.008, 0.0, 120_000)
        angle = math.radians(tilt)
        turn = np.array([[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]])
        yield f"tilt {tilt} deg", tilt, numbers(points @ turn.T)["tilt"].value


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--levels", action="store_true", help="also print each level")
    arguments = parser.parse_args()
    limit_threads(1)
    print(f"{setting()}\n")
    columns = (*NAMES, "MapEval MME", "MapEval MPV")
    print(f"{'ladder':12}" + "".join(f"{name:>16}" for name in columns))
    total = np.zeros(2)
    for name, levels, is_drift in (("noise", NOISE, False), ("drift", DRIFT, True)):
        correlations = []
        for seed in range(arguments.seeds):
            errors, rows, seconds = ladder(levels, seed, is_drift=is_drift)
            total += seconds
            correlations.append([spearman(errors, rows[:, k]) for k in range(len(columns))])
            if arguments.levels:
                for error, row in zip(errors, rows, strict=True):
                    print(f"   error {error:.4f}  " + "  ".join(f"{value:.5g}" for value in row))
        lowest, highest = np.min(correlations, axis=0), np.max(correlations, axis=0)
        print(f"{name:12}" + "".join(f"{f'{a:.2f} to {b:.2f}':>16}" for a, b in zip(lowest, highest, strict=True)))
    ours, peers = total / (2 * LEVELS * arguments.seeds)
    print(f"\nCPU seconds per map: ours (all numbers) {ours:.1f}, peer at 4,000 points {peers:.1f}\n")
    print(f"{'known value':24}{'truth':>8}{'recovered':>22}{'largest error':>16}")
    found: dict[str, tuple[float, list[float]]] = {}
    for seed in range(arguments.seeds):
        for name, truth, value in recoveries(seed):
            found.setdefault(name, (truth, []))[1].append(math.nan if value is None else value)
    for name, (truth, values) in found.items():
        worst = max(abs(value / truth - 1) for value in values)
        print(f"{name:24}{truth:>8.4g}{f'{min(values):.4g} to {max(values):.4g}':>22}{worst:>15.1%}")


if __name__ == "__main__":
    main()
