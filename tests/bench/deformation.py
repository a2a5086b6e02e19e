"""False alarms and power of the deformation verdict: python tests/bench/deformation.py [--runs 500] [--power-runs 100]

Pairs of one inner piece of the synthetic city (exact tangent planes) with white and correlated noise; every row is
its noise. Beside our verdict, on the same data: the model that the BIC of all pairs picks, and the minimum of
tile-blocked cross-validation. `--times` measures two whole clouds instead.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from measure import limit_threads, setting

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


NULL = (
    Cell("gauss", 0),
    *(Cell(kernel, ratio) for kernel in ("gauss", "exp") for ratio in (100, 40, 20, 10)),
    Cell("gauss", 40, 2.0),
    Cell("gauss", 20, 2.0),
    Cell("gauss", 25, 1.0, 200_000),
)
POWER = tuple(Cell("gauss", ratio) for ratio in (100, 40, 20, 10))
DOMES = (0.1, 0.25, 0.5, 1.0, 2.0)  # RMS, times the total noise
HEAD = f"{'N':>8}{'L m':>6}{'l m':>7}  {'noise':12}{'ratio':>5}"


class Scene:
    """Places and normals of one piece of the city, and all sums that do not depend on the residuals."""

    def __init__(self, points: int) -> None:
        from pcbench import deformation as d
        from pcbench.polynomials import monomials
        from pcbench.synthetic import city

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
            places, normals, zero, one, left=zero, lower=self.lower, side=self.side, center=np.zeros(3), radius=SIZE / 2
        )
        self.geometry = d.Geometry(self.sums)
        self.signs = d.bootstrap_signs(self.geometry, 0)
        cells = np.floor((places - self.lower) / self.side).astype(np.int64)
        self.order, self.starts = d._groups(cells)
        basis = monomials(places / (SIZE / 2))
        self.columns = np.einsum("an,nk->nak", basis, normals)  # (N, 20, 3)
        self.cubic = np.einsum("ab,nbk->nak", self.geometry.to_orthonormal, self.columns).reshape(points, -1)
        bowl = np.square(places[:, :2]).sum(axis=1) * normals[:, 2]
        affine = self.columns[:, :4].reshape(points, -1)
        bowl -= affine @ np.linalg.lstsq(affine, bowl, rcond=None)[0]
        self.dome = bowl / np.sqrt(np.mean(np.square(bowl)))

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

    def judge(self, residuals: np.ndarray) -> tuple[str, str, str, float]:
        """Our verdict, naive BIC's model, minimum CV's model, and our p-value under the noise."""
        from pcbench import deformation as d

        g = self.geometry
        sums = np.add.reduceat(self.columns[self.order] * residuals[self.order][:, None, None], self.starts)
        energy = np.add.reduceat(np.square(residuals)[self.order], self.starts)
        total = np.einsum("ab,bk->ak", g.to_orthonormal, sums.sum(axis=0)).ravel()
        left = residuals - self.cubic @ g.fit("cubic", total)
        dyadic = d.dyadic_moments(self.places, self.normals, left, np.ones(len(left)), self.lower, self.side)
        scores = d.Scores(g, sums, energy, dyadic)
        noise = d.estimate_noise(g, scores)
        found = d.decide(g, scores, noise, self.signs)
        rungs = d.climb(g, scores, noise, 0)
        count = len(residuals)
        bic = {
            m: count * np.log(energy.sum() - scores.total @ g.fit(m, scores.total)) + p * np.log(count)
            for m, p in d.PARAMETERS.items()
        }
        best = min(rungs, key=lambda rung: rung["cv_score"])["model"]
        return found.verdict, min(bic, key=lambda m: bic[m]), best, found.evidence.p_noise


def null(scenes: dict[int, Scene], runs: int) -> None:
    print(f"\nundeformed, {runs} runs a row: share of verdicts; wrong is any non-affine one")
    print(f"{HEAD}{'tiles':>6}{'none':>8}{'undecided':>10}{'affine':>8}{'wrong':>8}  {'naive BIC':>10}{'min CV':>8}")
    for cell in NULL:
        if cell.points not in scenes:
            scenes[cell.points] = Scene(cell.points)
        scene = scenes[cell.points]
        waves = scene.waves(cell)
        rows = [scene.judge(scene.noise(cell, waves, 1000 + run)) for run in range(runs)]
        tiles = len(scene.geometry.tile_matrices[1])
        verdicts = [row[0] for row in rows]
        share = {v: verdicts.count(v) / runs for v in ("none", "undecided", "affine", "similarity", "non-affine")}
        bent = [np.mean([row[k] in ("quadratic", "cubic") for row in rows]) for k in (1, 2)]
        print(
            f"{cell}{tiles:6}{share['none']:8.3f}{share['undecided']:10.3f}"
            f"{share['affine'] + share['similarity']:8.3f}{share['non-affine']:8.3f}  {bent[0]:10.3f}{bent[1]:8.3f}",
            flush=True,
        )


def power(scene: Scene, runs: int) -> None:
    tiles = len(scene.geometry.tile_matrices[1])
    print(f"\na dome, {runs} runs a row; its RMS along the normals beyond affine, times the total noise")
    print(f"{HEAD}{'tiles':>6}{'RMS':>6}{'found':>8}{'undecided':>10}  {'ROC: at 1 % false':>18}{'5 %':>7}{'area':>7}")
    for cell in POWER:
        waves = scene.waves(cell)
        without = np.array([scene.judge(scene.noise(cell, waves, 50_000 + run))[3] for run in range(runs)])
        for size in DOMES:
            bend = size * cell.total * scene.dome
            rows = [scene.judge(scene.noise(cell, waves, 90_000 + run) + bend) for run in range(runs)]
            verdicts, p = [row[0] for row in rows], np.array([row[3] for row in rows])
            at = [float(np.mean(p < np.quantile(without, share))) for share in (0.01, 0.05)]
            area = float(np.mean(p[:, None] < without[None]) + 0.5 * np.mean(p[:, None] == without[None]))
            print(
                f"{cell}{tiles:6}{size:6.2f}{verdicts.count('non-affine') / runs:8.2f}"
                f"{verdicts.count('undecided') / runs:10.2f}  {at[0]:18.2f}{at[1]:7.2f}{area:7.3f}",
                flush=True,
            )


def times(sizes: list[int]) -> None:
    """Seconds for two whole clouds that are registered and indexed, and whose normals are known, as in `compare`."""
    from pcbench.deformation_pairs import Side, residual_deformation
    from pcbench.neighbors import Index
    from pcbench.normals import Surface
    from pcbench.registration import recentring, register
    from pcbench.synthetic import demo

    print(f"\n{'reference':>10}{'candidate':>11}{'seconds':>9}  verdict")
    for size in sizes:
        scene = demo(size)
        origin = recentring(scene.reference)
        surface = Surface(Index(scene.reference.points - origin))
        surface.normals(np.arange(len(surface)))
        truth = Side(surface, np.ones(len(surface), bool), scene.reference)
        for cloud in scene.candidates.values():
            found = register(scene.reference, cloud, surface=surface)
            index = Index(found.T_local.apply(cloud.points - origin))
            seconds = []
            for _ in range(5):
                start = time.perf_counter()
                side = Side(Surface(index), np.ones(len(index), bool), cloud)
                answer = residual_deformation(truth, side, found, origin)
                seconds.append(time.perf_counter() - start)
            print(f"{size:10,}{len(cloud):11,}{np.median(seconds):9.2f}  {answer.verdict}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--power-runs", type=int, default=100)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--times", action="store_true")
    options = parser.parse_args()
    limit_threads(options.threads)
    print(setting())
    if options.times:
        return times([100_000, 1_270_820, 5_000_000])
    scenes = {POINTS: Scene(POINTS)}
    if options.power_runs:
        power(scenes[POINTS], options.power_runs)
    if options.runs:
        null(scenes, options.runs)


if __name__ == "__main__":
    main()
