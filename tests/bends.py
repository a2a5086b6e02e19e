"""Pairs of a piece of the synthetic city with known noise and known bends, for tests and benchmarks of deformation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcbench import Cloud
from pcbench.deformation import Deformation, Side, TileSums
from pcbench.deformation.model import MIN_INFORMATION, Geometry, Noise, Scores, estimate_noise
from pcbench.deformation.pairs import CELLS_ALONG, Pairs, PairSearch, tile_sums
from pcbench.deformation.polynomials import monomials
from pcbench.deformation.residual import residual_deformation
from pcbench.deformation.sums import dyadic_moments, group_rows
from pcbench.deformation.verdict import Finding, PairEvidence, decide
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.registration import Target, local_origin, register
from pcbench.scenes.synthetic import city

SIGMA = 0.02  # m, standard deviation of the white noise
SIZE = 200.0  # m, L
POINTS = 15_000
MIN_NORMAL_SHARE = np.sqrt(MIN_INFORMATION)


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


class Evaluation(NamedTuple):
    finding: Finding
    scores: Scores
    noise: Noise


class Scene:
    """Places and normals of one piece of the city, and all sums that do not depend on the residuals."""

    def __init__(self, points: int) -> None:
        rng = np.random.default_rng(0)
        patches = city(0).patches
        areas = patches.areas()
        places, normals = np.empty((0, 3)), np.empty((0, 3))
        while len(places) < points:
            triangles = patches.take(rng.choice(len(areas), size=points, p=areas / areas.sum()))
            s, t = rng.random((2, points))
            is_outside = (triangles.triangle == 1) & (s + t > 1)
            s, t = np.where(is_outside, 1 - s, s), np.where(is_outside, 1 - t, t)
            x = triangles.corner + s[:, None] * triangles.u + t[:, None] * triangles.v
            n = np.cross(triangles.u, triangles.v)
            is_inside = (np.abs(x[:, :2]) < SIZE / 2).all(axis=1)
            places = np.concatenate([places, x[is_inside]])[:points]
            normals = np.concatenate([normals, (n / np.linalg.norm(n, axis=1, keepdims=True))[is_inside]])[:points]
        self.places, self.normals = places, normals
        self.lower, self.side = places.min(axis=0), SIZE / CELLS_ALONG
        zeros, ones = np.zeros(points), np.ones(points)
        self.sums = TileSums.of(
            places,
            normals,
            zeros,
            ones,
            scales=ones,
            remainders=zeros,
            raw_remainders=zeros,
            quality=ones,
            areas=ones,
            lower=self.lower,
            side=self.side,
            center=np.zeros(3),
            radius=SIZE / 2,
        )
        self.geometry = Geometry(self.sums)
        cells = np.floor((places - self.lower) / self.side).astype(np.int64)
        self.order, self.starts = group_rows(cells)
        basis = monomials(places / (SIZE / 2))
        self.columns = np.einsum("an,nk->nak", basis, normals)  # (N, 20, 3)
        self.cubic = np.einsum("ab,nbk->nak", self.geometry.to_orthonormal, self.columns).reshape(points, -1)

    def beyond_affine(self, field: np.ndarray) -> np.ndarray:
        """Return the components (N,) along normals of displacements (N, 3) beyond an affine field, scaled to RMS 1."""
        affine = self.columns[:, :4].reshape(len(field), -1)
        along_normals = (field * self.normals).sum(axis=1)
        along_normals -= affine @ np.linalg.lstsq(affine, along_normals, rcond=None)[0]
        return along_normals / np.sqrt(np.mean(np.square(along_normals)))

    def waves(self, cell: Cell) -> np.ndarray | None:
        """Return random Fourier features (N, 2 F) of the cell's kernel (Rahimi & Recht 2007)."""
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

    def judge(self, residuals: np.ndarray) -> Evaluation:
        g = self.geometry
        sums = np.add.reduceat(self.columns[self.order] * residuals[self.order][:, None, None], self.starts)
        energy = np.add.reduceat(np.square(residuals)[self.order], self.starts)
        total = np.einsum("ab,bk->ak", g.to_orthonormal, sums.sum(axis=0)).ravel()
        remainder = residuals - self.cubic @ g.fit("cubic", total)
        ones = np.ones(len(remainder))
        _, powers = dyadic_moments(self.places, self.normals, remainder, ones, ones, self.lower, self.side)
        scores = Scores(g, sums, energy, powers)
        noise = estimate_noise(g, scores)
        return Evaluation(decide([PairEvidence(self.sums, g, scores, noise)]), scores, noise)

    def fitted(self, evaluation: Evaluation) -> np.ndarray:
        """Return the selected model's displacements (N,) along the normals beyond an affine field."""
        step = self.geometry.step("affine", evaluation.finding.model)
        return self.cubic @ (step.modes @ (step.modes.T @ evaluation.scores.total))


class HalvesScene:
    """Two disjoint random halves of a real cloud, each with independent white and correlated noise.

    Args:
        cloud: a cloud with classes.
        noise: standard deviation of each kind of noise along each axis in each half; the correlation length is a
            sixtieth of the scene.
        seed: seed of the halves and their noise.
    """

    def __init__(self, cloud: Cloud, noise: float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        is_in_first = rng.random(len(cloud)) < 0.5
        points = cloud.points - cloud.points.mean(axis=0)
        self.size = float(np.ptp(points[:, :2], axis=0).max())
        sides = []
        for _ in range(2):
            waves = np.zeros_like(points)
            # Many waves, so that no single one dominates: a few long waves would be a real deformation.
            for _ in range(10):
                frequencies, phases = rng.normal(size=(50, 3)) / (self.size / 60), rng.uniform(0, 2 * np.pi, 50)
                waves += np.cos(points @ frequencies.T + phases) @ rng.normal(0, np.sqrt(2 / 500), (50, 3))
            sides.append(points + noise * waves + rng.normal(0, noise, points.shape))
        self.noise = 2 * noise  # along a normal: two kinds, two halves
        self._reference = self._half(cloud, sides[0], is_in_first)
        self._candidate = self._half(cloud, sides[1], ~is_in_first)
        self._origin = local_origin(self._reference)
        self._surface = Surface(Index(self._reference.points - self._origin))
        _, self._pairs = self._judge(np.zeros_like(self._candidate.points))

    @staticmethod
    def _half(cloud: Cloud, points: np.ndarray, is_in_half: np.ndarray) -> Cloud:
        classes = cloud.attributes["classification"]
        return Cloud(points[is_in_half], unit=cloud.unit, attributes={"classification": classes[is_in_half]})

    def judge(self, kind: str | None, times: float) -> tuple[Deformation, float]:
        """Return the verdict on a bent candidate, and the error of the recovered field as a share of its RMS.

        The RMS along normals, beyond an affine field, is `times` the noise. If normals hardly show the bend, which then
        cannot be found, its total RMS has that size.
        """
        if kind is None:
            return self._judge(np.zeros_like(self._candidate.points))[0], 0.0
        rms_along_normals, total_rms = self.shown(kind)
        scale = (
            times * self.noise / (rms_along_normals if rms_along_normals >= MIN_NORMAL_SHARE * total_rms else total_rms)
        )
        deformation, pairs = self._judge(scale * bends(self._candidate.points, self.size)[kind])
        truth = self._beyond_affine(pairs, scale * bends(pairs.places + self._origin, self.size)[kind])
        sums = tile_sums(pairs)
        geometry = Geometry(sums)
        step = geometry.step("affine", deformation.model if deformation.model in ("quadratic", "cubic") else "cubic")
        coefficients = step.modes @ (step.modes.T @ Scores(geometry, sums.scores, sums.energy, sums.powers).total)
        values = geometry.to_orthonormal @ monomials((pairs.places - geometry.center) / geometry.radius)
        fitted = np.einsum("an,ak,nk->n", values, coefficients.reshape(-1, 3), pairs.normals)
        error = np.average(np.square(fitted - truth), weights=pairs.weights)
        return deformation, float(np.sqrt(error)) / (times * self.noise)

    def shown(self, kind: str) -> tuple[float, float]:
        """Return the RMS of a bend beyond an affine field: along the normals of the undeformed pairs, and in total."""
        field, weights = bends(self._pairs.places + self._origin, self.size)[kind], self._pairs.weights
        affine, root = monomials(self._pairs.places)[:4].T, np.sqrt(weights)[:, None]
        residual = field - affine @ np.linalg.lstsq(affine * root, field * root, rcond=None)[0]
        squares = np.square(self._beyond_affine(self._pairs, field)), np.square(residual).sum(axis=1)
        rms_along_normals, total_rms = (float(np.sqrt(np.average(square, weights=weights))) for square in squares)
        return rms_along_normals, total_rms

    def _judge(self, field: np.ndarray) -> tuple[Deformation, Pairs]:
        """Return the verdict of `deform`, and the pairs."""
        cloud = Cloud(self._candidate.points + field, unit=self._candidate.unit, attributes=self._candidate.attributes)
        registration = register(self._reference, cloud, target=Target(self._surface))
        registered_points = registration.T_local.apply(cloud.points - self._origin)
        sides = [
            Side(surface, np.ones(len(surface), dtype=bool), side)
            for surface, side in ((self._surface, self._reference), (Surface(Index(registered_points)), cloud))
        ]
        search = PairSearch.of(*sides)
        assert search is not None
        pairs = search.find(follow=True)
        assert pairs is not None
        return residual_deformation(*sides, registration, self._origin), pairs

    @staticmethod
    def _beyond_affine(pairs: Pairs, field: np.ndarray) -> np.ndarray:
        affine = np.einsum("an,nk->nak", monomials(pairs.places / np.abs(pairs.places).max())[:4], pairs.normals)
        root = np.sqrt(pairs.weights)
        columns, along_normals = affine.reshape(len(field), -1), (field * pairs.normals).sum(axis=1)
        return along_normals - columns @ np.linalg.lstsq(columns * root[:, None], along_normals * root, rcond=None)[0]


def bends(places: np.ndarray, size: float) -> dict[str, np.ndarray]:
    """Displacements (N, 3) of each kind, of any scale; the scene has the edge `size` and its centre at the origin."""
    x, y, z = (places / (size / 2)).T
    r2, zeros = x**2 + y**2, np.zeros(len(places))
    distance = np.clip(y + 1, 0, None)  # drift starts at one edge and accumulates
    waves = np.sin(np.pi * x / 2), np.cos(np.pi * y / 2)
    return {
        "dome": np.stack([zeros, zeros, -r2], axis=1),
        "bowl": np.stack([zeros, zeros, r2], axis=1),
        "twist": np.stack([-y * x, x * x, zeros], axis=1),
        "shear with height": np.stack([z * z, zeros, zeros], axis=1),
        "radial cubic": np.stack([x * r2, y * r2, zeros], axis=1),
        "strip drift": np.stack([0.3 * distance**2, zeros, distance**3], axis=1),
        "half wave of a sine": np.stack([zeros, zeros, waves[0]], axis=1),
        "half wave of a cosine": np.stack([zeros, zeros, waves[1]], axis=1),
    }
