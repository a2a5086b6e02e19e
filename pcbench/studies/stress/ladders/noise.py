"""Ladders of noise in the candidate, in spacings of the reference, and of outliers.

Their steps cover those of ModelNet40-C (noise of 1 to 5 % of the extent), which are about 3 to 15 spacings here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.studies.stress.ladders.ladder import Ladder
from pcbench.studies.stress.metrics import METRICS
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.verdicts import VERDICTS

_ALL = (REGISTRATION, METRICS, VERDICTS)
_LEVELS = (0, 0.25, 0.5, 1, 2, 4, 8)
_CORRELATION_SHARE = 0.05  # correlation length of the correlated noise, over the extent
_WAVES = 60


def _with_noise(pair: StressPair, noise: FloatArray) -> StressPair:
    """Add displacements (M, 3) to the candidate, and their RMS per axis to its noise."""
    added = float(np.sqrt(np.square(noise).sum(axis=1).mean() / 3))
    moved = pair.with_points(pair.points + noise)
    return replace(moved, candidate_noise=float(np.hypot(pair.candidate_noise, added)))


def _gaussian(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    return _with_noise(pair, rng.normal(0, level * pair.spacing, pair.points.shape))


def _uniform(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    half_width = np.sqrt(3) * level * pair.spacing
    return _with_noise(pair, rng.uniform(-half_width, half_width, pair.points.shape))


def _heavy_tailed(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Add noise of Student's t distribution with 2 degrees of freedom, whose variance is infinite."""
    moved = pair.with_points(pair.points + level * pair.spacing * rng.standard_t(2, pair.points.shape))
    return replace(moved, candidate_noise=float(np.hypot(pair.candidate_noise, level * pair.spacing)))


def _along_the_ray(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Add noise along the rays of a scanner above the middle of the scene."""
    position = pair.points.mean(axis=0) + [0, 0, 0.6 * pair.extent]
    rays = pair.points - position
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return _with_noise(pair, rays * rng.normal(0, level * pair.spacing, (len(rays), 1)))


def _growing(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Add noise that grows with the squared distance from the edge of the scene, as that of stereo does."""
    distances = pair.points[:, 0] - pair.points[:, 0].min()
    factor = np.square(distances / distances.max())
    sigma = level * pair.spacing * factor / np.sqrt(np.mean(factor**2))
    return _with_noise(pair, rng.normal(size=pair.points.shape) * sigma[:, None])


def _correlated(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Add noise along the normals that neighbouring points share: a Gaussian random field."""
    return _with_noise(pair, level * pair.spacing * _field(pair, rng)[:, None] * _directions(pair))


def _impulse(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Displace a share of the points by 5 % of the extent."""
    hit = rng.random(len(pair.points)) < level / 100
    noise = np.where(hit[:, None], rng.normal(0, 0.05 * pair.extent / np.sqrt(3), pair.points.shape), 0.0)
    return pair.with_points(pair.points + noise)


def _background(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Add uniform points in the box of the candidate, which become this share of its points."""
    count = round(len(pair.points) * level / (100 - level))
    low, high = pair.points.min(axis=0), pair.points.max(axis=0)
    points = np.concatenate([pair.points, rng.uniform(low, high, (count, 3))])
    return pair.with_points(points, np.concatenate([pair.normals, np.zeros((count, 3))]))


def _floaters(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Add clumps of points beside the surface, up to 10 % of the extent away, as splatting leaves them."""
    count = round(len(pair.points) * level / (100 - level))
    clumps = max(1, len(pair.points) // 400)
    centres = pair.points[rng.integers(len(pair.points), size=clumps)]
    centres = centres + rng.normal(0, 0.1 * pair.extent / np.sqrt(3), centres.shape)
    spread = rng.normal(0, 2 * pair.spacing, (count, 3))
    points = np.concatenate([pair.points, centres[rng.integers(clumps, size=count)] + spread])
    return pair.with_points(points, np.concatenate([pair.normals, np.zeros((count, 3))]))


def _field(pair: StressPair, rng: np.random.Generator) -> FloatArray:
    """Return a Gaussian random field (M,) of unit variance at the candidate's points, from random waves."""
    length = _CORRELATION_SHARE * pair.extent
    waves, phases = rng.normal(0, 1 / length, (3, _WAVES)), rng.uniform(0, 2 * np.pi, _WAVES)
    values: FloatArray = np.sqrt(2 / _WAVES) * np.cos(pair.points @ waves + phases).sum(axis=1)
    return values


def _directions(pair: StressPair) -> FloatArray:
    """Return the normals, and the vertical where they are unknown."""
    has_normal = np.linalg.norm(pair.normals, axis=1, keepdims=True) > 0.5
    directions: FloatArray = np.where(has_normal, pair.normals, [0.0, 0.0, 1.0])
    return directions


def _noise_ladder(name: str, title: str, perturb: object, quick: tuple[float, ...] = ()) -> Ladder:
    assert callable(perturb)
    return Ladder(f"noise-{name}", title, "noise", "spacings", _LEVELS, quick, perturb, _ALL)


NOISE_LADDERS = (
    _noise_ladder("gaussian", "Gaussian noise", _gaussian, (0, 1, 4)),
    _noise_ladder("uniform", "uniform noise", _uniform),
    _noise_ladder("heavy-tailed", "heavy-tailed noise", _heavy_tailed),
    _noise_ladder("ray", "noise along the ray", _along_the_ray),
    _noise_ladder("distance", "noise that grows with distance", _growing),
    _noise_ladder("correlated", "correlated noise", _correlated),
    Ladder("impulse", "displaced points", "noise", "%", (0, 3, 5, 10, 20, 40, 60), (), _impulse, _ALL),
    Ladder("background", "uniform outliers", "noise", "%", (0, 5, 10, 20, 40, 60), (0, 20, 60), _background, _ALL),
    Ladder("floaters", "clumps beside the surface", "noise", "%", (0, 5, 10, 20, 40, 60), (), _floaters, _ALL),
)
