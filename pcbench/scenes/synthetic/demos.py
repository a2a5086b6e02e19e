"""A small procedural city with exactly known geometry, and clouds of it that resemble reconstructions."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity, rotation_about

SIZE = 400.0  # metres along each side of the demo city

_GROUND, _WALL, _ROOF = 0, 1, 2
_COLORS = np.array([[122, 132, 112], [205, 194, 176], [166, 92, 74]], dtype=np.uint8)


class Patches(NamedTuple):
    """Flat surface patches: corner + s * u + t * v with s, t in [0, 1], and s + t <= 1 for a triangle."""

    corner: FloatArray  # (P, 3)
    u: FloatArray  # (P, 3)
    v: FloatArray  # (P, 3)
    triangle: IntArray  # (P,) 0 or 1
    kind: IntArray  # (P,) ground, wall or roof

    def take(self, which: IntArray) -> Patches:
        """Return the patches with the given indices."""
        return Patches(self.corner[which], self.u[which], self.v[which], self.triangle[which], self.kind[which])

    def areas(self) -> FloatArray:
        """Return the areas (P,) in square metres."""
        areas: FloatArray = np.linalg.norm(np.cross(self.u, self.v), axis=1) * np.where(self.triangle == 1, 0.5, 1.0)
        return areas


@dataclass(frozen=True, eq=False)
class City:
    """Terrain z = relief(x, y) with buildings on it; the surface can be sampled at any density."""

    patches: Patches

    def sample(self, count: int, rng: np.random.Generator, falloff: float = np.inf) -> tuple[FloatArray, IntArray]:
        """Sample points (N, 3) on the surface, uniformly by area, with their kinds (N,).

        Args:
            count: number of points.
            rng: random generator.
            falloff: if finite, the density decreases with the distance r from the centre as exp(-r / falloff), in
                metres.
        """
        parts: list[FloatArray] = []
        kinds: list[IntArray] = []
        missing = count
        share = 1.0
        while missing > 0:
            points, kind = self._uniform(int(missing / share * 1.1) + 64, rng)
            if np.isfinite(falloff):
                keep = rng.random(len(points)) < np.exp(-np.hypot(points[:, 0], points[:, 1]) / falloff)
                share = max(0.01, float(keep.mean()))
                points, kind = points[keep], kind[keep]
            parts.append(points[:missing])
            kinds.append(kind[:missing])
            missing -= len(parts[-1])
        return np.concatenate(parts), np.concatenate(kinds)

    def _uniform(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
        areas = self.patches.areas()
        which = rng.choice(len(areas), size=count, p=areas / areas.sum())
        s, t = rng.random((2, count))
        fold = (self.patches.triangle[which] == 1) & (s + t > 1)
        s, t = np.where(fold, 1 - s, s), np.where(fold, 1 - t, t)
        patch = self.patches.take(which)
        points = patch.corner + s[:, None] * patch.u + t[:, None] * patch.v
        ground = patch.kind == _GROUND
        points[ground, 2] = relief(points[ground, 0], points[ground, 1])
        return points, patch.kind


def relief(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of the bare ground in metres: gentle waves on a slight slope."""
    return 2.0 * np.sin(x / 83.0) * np.cos(y / 67.0) + 0.01 * x


def city(seed: int = 0) -> City:
    """Build a city: streets every 50 m, two to four boxes per block, half of them gabled, taller in the centre."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[FloatArray, FloatArray, FloatArray, int, int]] = []
    footprints: list[tuple[float, float, float, float]] = []
    block, street = 50.0, 10.0
    for x0 in np.arange(-SIZE / 2, SIZE / 2, block):
        for y0 in np.arange(-SIZE / 2, SIZE / 2, block):
            inner = block - street
            cut = rng.uniform(0.35, 0.65, size=2) * inner
            cells = [
                (0, 0, cut[0], cut[1]),
                (cut[0], 0, inner, cut[1]),
                (0, cut[1], cut[0], inner),
                (*cut, inner, inner),
            ]
            for xa, ya, xb, yb in (cells[i] for i in rng.permutation(4)[: rng.integers(2, 5)]):
                gap = 1.5
                lower = np.array([x0 + street / 2 + xa + gap, y0 + street / 2 + ya + gap])
                width, depth = xb - xa - 2 * gap, yb - ya - 2 * gap
                distance = np.hypot(*(lower + np.array([width, depth]) / 2))
                height = rng.uniform(4, 10) + 30 * np.exp(-((distance / 70) ** 2)) * rng.uniform(0.3, 1.0)
                gabled = bool(rng.random() < 0.5) and height < 18
                rows += _building(lower, width, depth, height, gabled)
                footprints.append((lower[0], lower[1], lower[0] + width, lower[1] + depth))
    rows += _ground(footprints)
    corner, u, v, triangle, kind = zip(*rows, strict=True)
    return City(Patches(np.array(corner), np.array(u), np.array(v), np.array(triangle), np.array(kind)))


def _building(
    lower: FloatArray, width: float, depth: float, height: float, gabled: bool
) -> list[tuple[FloatArray, FloatArray, FloatArray, int, int]]:
    x, y = lower
    # Walls extend to 10 cm below the lowest ground under the building.
    corners_x, corners_y = np.array([x, x + width, x, x + width]), np.array([y, y, y + depth, y + depth])
    base = float(relief(corners_x, corners_y).min()) - 0.1
    up = np.array([0.0, 0.0, height])
    east, north = np.array([width, 0.0, 0.0]), np.array([0.0, depth, 0.0])
    foot = np.array([x, y, base])
    rows = [
        (foot, east, up, 0, _WALL),
        (foot + north, east, up, 0, _WALL),
        (foot, north, up, 0, _WALL),
        (foot + east, north, up, 0, _WALL),
    ]
    eaves = foot + up
    if not gabled:
        return [*rows, (eaves, east, north, 0, _ROOF)]
    rise = np.array([0.0, 0.0, 0.4 * width])
    half = east / 2
    return [
        *rows,
        (eaves, half + rise, north, 0, _ROOF),
        (eaves + east, rise - half, north, 0, _ROOF),
        (eaves, east, half + rise, 1, _WALL),
        (eaves + north, east, half + rise, 1, _WALL),
    ]


def _ground(
    footprints: list[tuple[float, float, float, float]],
) -> list[tuple[FloatArray, FloatArray, FloatArray, int, int]]:
    """Return the ground outside the footprints as rectangles, cut along all footprint edges of a block."""
    rows: list[tuple[FloatArray, FloatArray, FloatArray, int, int]] = []
    block = 50.0
    for x0 in np.arange(-SIZE / 2, SIZE / 2, block):
        for y0 in np.arange(-SIZE / 2, SIZE / 2, block):
            inside = [f for f in footprints if x0 <= f[0] < x0 + block and y0 <= f[1] < y0 + block]
            xs = np.unique([x0, x0 + block, *(f[0] for f in inside), *(f[2] for f in inside)])
            ys = np.unique([y0, y0 + block, *(f[1] for f in inside), *(f[3] for f in inside)])
            for xa, xb in pairwise(xs):
                for ya, yb in pairwise(ys):
                    cx, cy = (xa + xb) / 2, (ya + yb) / 2
                    if any(f[0] < cx < f[2] and f[1] < cy < f[3] for f in inside):
                        continue
                    corner = np.array([xa, ya, 0.0])
                    rows.append((corner, np.array([xb - xa, 0, 0]), np.array([0, yb - ya, 0]), 0, _GROUND))
    return rows


@dataclass(frozen=True, eq=False)
class Demo:
    """Reference and two candidate clouds of one city, with their true poses and deformations."""

    reference: Cloud
    candidates: dict[str, Cloud]
    T_reference_candidate: dict[str, Similarity]  # true pose of each candidate, exact
    bend_rms: dict[str, float]  # RMS of each candidate's vertical deformation, in metres

    def registration_error(self, name: str, estimate: Similarity) -> float:
        """RMS distance in metres between a candidate's points under an estimated and under the true registration.

        Args:
            name: name of the candidate.
            estimate: estimated registration, candidate -> reference.
        """
        points = self.candidates[name].points
        differences = estimate.apply(points) - self.T_reference_candidate[name].apply(points)
        return float(np.sqrt(np.mean(np.square(differences).sum(axis=1))))


def demo(points: int = 1_270_820, seed: int = 0) -> Demo:
    """Build a dense reference, and a sparse and a densified candidate with point counts in the ratios of Gao et al.

    The density of the candidates decreases from the centre. They have noise, outliers and a rigid offset. The densified
    one is also slightly deformed: a bowl of 5 cm RMS.

    Args:
        points: number of points of the reference.
        seed: random seed.
    """
    scene = city(seed)
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)]
    surface, kinds = scene.sample(points, streams[0])
    reference = Cloud(surface + streams[0].normal(0, 0.02, surface.shape), colors=_COLORS[kinds], unit="m")

    settings = {  # share of the points, falloff (m), noise (m), outliers, bend (m RMS), angle (deg), shift (m)
        "sparse": (12_773 / 1_270_820, 150.0, 0.06, 0.01, 0.0, 0.4, (0.5, -0.3, 0.2)),
        "densified": (244_849 / 1_270_820, 120.0, 0.04, 0.02, 0.05, -0.3, (-0.4, 0.6, -0.25)),
    }
    candidates: dict[str, Cloud] = {}
    truth: dict[str, Similarity] = {}
    bends: dict[str, float] = {}
    for (name, row), rng in zip(settings.items(), streams[1:], strict=True):
        share, falloff, noise, outliers, bend, angle_deg, shift = row
        surface, kinds = scene.sample(max(100, round(share * points)), rng, falloff)
        r2 = np.square(surface[:, :2]).sum(axis=1)
        bowl = r2 - r2.mean()
        surface[:, 2] += bend * bowl / np.sqrt(np.mean(bowl**2))
        surface += rng.normal(0, noise, surface.shape)
        is_outlier = rng.random(len(surface)) < outliers
        surface[is_outlier] += rng.normal(0, 1.5, (int(is_outlier.sum()), 3))
        T = _motion(angle_deg, shift)
        candidates[name] = Cloud(T.inverse().apply(surface), colors=_COLORS[kinds], unit="m")
        truth[name], bends[name] = T, bend
    return Demo(reference, candidates, truth, bends)


def _motion(angle_deg: float, shift: tuple[float, float, float]) -> Similarity:
    """Return a rotation about an oblique axis through the origin, followed by a translation."""
    axis = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    return Similarity(rotation_about(axis, np.radians(angle_deg)), np.array(shift))
