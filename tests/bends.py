"""Pairs of a piece of the synthetic city with known noise and known bends, for tests and benchmarks of deformation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcbench import deformation as d
from pcbench.polynomials import monomials
from pcbench.synthetic import city

SIGMA = 0.02  # m, of the white noise
SIZE = 200.0  # m, L
POINTS = 15_000


@dataclass(frozen=True)
class Cell:
    """A kind of noise: kernel (gauss: exp(-d^2 / 2 l^2), exp: exp(-d / l)), L / l (0: white), its share, pairs."""

    kernel: str
    ratio: int
    correlated: float = 1.0  # times SIGMA
    points: int = POINTS

    @property
    def length(self) -> float:
        return SIZE / self.ratio if self.ratio else 0.0

    @property
    def total(self) -> float:
        return SIGMA * float(np.hypot(1, self.correlated if self.ratio else 1.0))

    def __str__(self) -> str:
        name = f"L/{self.ratio} {self.kernel}" if self.ratio else "white"
        return f"{self.points:8}{SIZE:6.0f}{self.length:7.1f}  {name:12}{self.correlated if self.ratio else 0:5.1f}"


class Judged(NamedTuple):
    finding: d.Finding
    scores: d.Scores
    noise: d.Noise


class Scene:
    """Places and normals of one piece of the city, and all sums that do not depend on the residuals."""

    def __init__(self, points: int) -> None:
        rng = np.random.default_rng(0)
        patches = city(0).patches
        areas = patches.areas()
        places, normals = np.empty((0, 3)), np.empty((0, 3))
        while len(places) < points:
            which = patches.take(rng.choice(len(areas), size=points, p=areas / areas.sum()))
            s, t = rng.random((2, points))
            fold = (which.triangle == 1) & (s + t > 1)
            s, t = np.where(fold, 1 - s, s), np.where(fold, 1 - t, t)
            x = which.corner + s[:, None] * which.u + t[:, None] * which.v
            n = np.cross(which.u, which.v)
            kept = (np.abs(x[:, :2]) < SIZE / 2).all(axis=1)
            places = np.concatenate([places, x[kept]])[:points]
            normals = np.concatenate([normals, (n / np.linalg.norm(n, axis=1, keepdims=True))[kept]])[:points]
        self.places, self.normals = places, normals
        self.lower, self.side = places.min(axis=0), SIZE / d.CELLS_ALONG
        zero, one = np.zeros(points), np.ones(points)
        self.sums = d.TileSums.of(
            places,
            normals,
            zero,
            one,
            left=zero,
            quality=one,
            lower=self.lower,
            side=self.side,
            center=np.zeros(3),
            radius=SIZE / 2,
        )
        self.geometry = d.Geometry(self.sums)
        self.signs = d.bootstrap_signs(self.geometry, 0)
        cells = np.floor((places - self.lower) / self.side).astype(np.int64)
        self.order, self.starts = d._groups(cells)
        basis = monomials(places / (SIZE / 2))
        self.columns = np.einsum("an,nk->nak", basis, normals)  # (N, 20, 3)
        self.cubic = np.einsum("ab,nbk->nak", self.geometry.to_orthonormal, self.columns).reshape(points, -1)

    def beyond_affine(self, field: np.ndarray) -> np.ndarray:
        """(N,) what normals show of displacements (N, 3) beyond an affine field, scaled to an RMS of one."""
        affine = self.columns[:, :4].reshape(len(field), -1)
        seen = (field * self.normals).sum(axis=1)
        seen -= affine @ np.linalg.lstsq(affine, seen, rcond=None)[0]
        return seen / np.sqrt(np.mean(np.square(seen)))

    def waves(self, cell: Cell) -> np.ndarray | None:
        """(N, 2 F) random Fourier features of the cell's kernel (Rahimi & Recht 2007)."""
        if not cell.ratio:
            return None
        rng = np.random.default_rng(5)
        frequencies = rng.normal(size=(250 if cell.points > 50_000 else 1000, 3)) / cell.length
        if cell.kernel == "exp":  # its spectrum is a multivariate Cauchy distribution
            frequencies /= np.abs(rng.normal(size=(len(frequencies), 1)))
        phase = (self.places @ frequencies.T).astype(np.float32)
        return np.hstack([np.cos(phase), np.sin(phase)]) / np.float32(np.sqrt(len(frequencies)))

    def noise(self, cell: Cell, waves: np.ndarray | None, seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        if waves is None:
            return rng.normal(0, cell.total, len(self.places))
        field = waves @ rng.normal(size=(waves.shape[1], 3)).astype(np.float32)
        return cell.correlated * SIGMA * (field * self.normals).sum(axis=1) + rng.normal(0, SIGMA, len(self.places))

    def judge(self, residuals: np.ndarray) -> Judged:
        g = self.geometry
        sums = np.add.reduceat(self.columns[self.order] * residuals[self.order][:, None, None], self.starts)
        energy = np.add.reduceat(np.square(residuals)[self.order], self.starts)
        total = np.einsum("ab,bk->ak", g.to_orthonormal, sums.sum(axis=0)).ravel()
        left = residuals - self.cubic @ g.fit("cubic", total)
        dyadic = d.dyadic_moments(self.places, self.normals, left, np.ones(len(left)), self.lower, self.side)
        scores = d.Scores(g, sums, energy, dyadic)
        noise = d.estimate_noise(g, scores)
        return Judged(d.decide(g, scores, noise, self.signs), scores, noise)

    def fitted(self, judged: Judged) -> np.ndarray:
        """(N,) what the chosen model shows along the normals beyond an affine field."""
        step = self.geometry.step("affine", judged.finding.model)
        return self.cubic @ (step.modes @ (step.modes.T @ judged.scores.total))


def bends(places: np.ndarray, size: float) -> dict[str, np.ndarray]:
    """Displacements (N, 3) of each kind, of any scale; the scene has the edge `size` and its centre at the origin."""
    x, y, z = (places / (size / 2)).T
    r2, zero = x**2 + y**2, np.zeros(len(places))
    along = np.clip(y + 1, 0, None)  # drift starts at one edge and accumulates
    waves = np.sin(np.pi * x / 2), np.cos(np.pi * y / 2)
    return {
        "dome": np.stack([zero, zero, -r2], axis=1),
        "bowl": np.stack([zero, zero, r2], axis=1),
        "twist": np.stack([-y * x, x * x, zero], axis=1),
        "shear with height": np.stack([z * z, zero, zero], axis=1),
        "radial cubic": np.stack([x * r2, y * r2, zero], axis=1),
        "strip drift": np.stack([0.3 * along**2, zero, along**3], axis=1),
        "half wave of a sine": np.stack([zero, zero, waves[0]], axis=1),
        "half wave of a cosine": np.stack([zero, zero, waves[1]], axis=1),
    }
