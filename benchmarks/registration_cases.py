"""Cases for the registration benchmark: two samples of one city, their true transform, and the varied parameters."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity
from pcbench.scenes.synthetic import city


class Case(NamedTuple):
    """Parameters of two clouds; by default 2 degrees and half a metre apart."""

    angle_deg: float = 2.0
    offset: float = 0.5  # metres
    overlap: float = 1.0  # share of each window that is in the other
    outliers: float = 0.0  # share of the candidate's points
    scale: float = 1.0
    density: float = 2.0  # reference points per candidate point
    shape: str = "city"


class Sweep(NamedTuple):
    """Values of one parameter, and the case of each value."""

    title: str
    unit: str
    values: tuple[float | str, ...]
    case: Callable[[float | str], Case]
    quick: tuple[float | str, ...]
    everyone: bool  # whether methods without an initial pose take part; otherwise refinements do


SWEEPS = {
    "rotation": Sweep("Start off by", "degrees", (5, 10, 20, 30, 45, 60), lambda v: Case(angle_deg=v), (10, 45), False),
    "offset": Sweep("Start off by", "metres", (1, 5, 10, 20, 40), lambda v: Case(offset=v), (5, 20), False),
    "overlap": Sweep("Overlap", "%", (100, 70, 40, 20, 10), lambda v: Case(overlap=v / 100), (40, 10), False),
    "outliers": Sweep("Outliers", "%", (10, 30, 50), lambda v: Case(outliers=v / 100), (50,), False),
    "scale": Sweep("Scale", "factor", (1.002, 1.03, 1.2), lambda v: Case(scale=v), (1.03,), False),
    "density": Sweep("Density", "to 1", (1, 8, 33), lambda v: Case(density=v), (33,), False),
    "degenerate": Sweep("Degenerate", "", ("plane", "tunnel"), lambda v: Case(shape=v), ("plane",), False),
    "nothing": Sweep(
        "Overlap, any pose", "%", (100, 40, 20), lambda v: Case(angle_deg=-1, overlap=v / 100), (40,), True
    ),
}
# Our global methods take part in these sweeps too.
ALSO_GLOBAL = {
    "overlap": ("global",),
    "outliers": ("global",),
    "scale": ("global-similarity",),
    "degenerate": ("global", "global-similarity"),
}


def clouds(case: Case, seed: int) -> tuple[FloatArray, FloatArray, Similarity]:
    """Return reference, candidate and true transform. A scene is 200 m x 200 m, or a plane or tunnel of 40 m."""
    rng = np.random.default_rng(seed)
    count = 80_000
    if case.shape == "city":
        scene = city(seed)
        width = 200 / (2 - case.overlap)
        sizes = (count, count / case.density)
        reference, candidate = (scene.sample(int(4.4 * n), rng)[0] for n in sizes)
        reference, candidate = (p[np.abs(p[:, :2]).max(axis=1) < 100] for p in (reference, candidate))
        reference, candidate = reference[reference[:, 0] < width - 100], candidate[candidate[:, 0] > 100 - width]
    else:
        reference, candidate = (_degenerate(case.shape, int(n), rng) for n in (count, count / case.density))
    reference, candidate = (p + rng.normal(0, 0.02, p.shape) for p in (reference, candidate))
    outlier_count = round(len(candidate) * case.outliers / (1 - case.outliers))
    candidate = np.concatenate([candidate, rng.uniform(candidate.min(0), candidate.max(0), (outlier_count, 3))])
    angle = rng.uniform(45, 180) if case.angle_deg < 0 else case.angle_deg
    axis, heading = rng.normal(size=3), rng.uniform(0, 2 * np.pi)
    shift = case.offset * np.array([np.cos(heading), np.sin(heading), 0.0])
    R, center = rotation(axis / np.linalg.norm(axis), np.radians(angle)), candidate.mean(axis=0)
    T_true = Similarity(R, center + shift - case.scale * R @ center, case.scale)
    return reference, T_true.inverse().apply(candidate), T_true


def _degenerate(shape: str, count: int, rng: np.random.Generator) -> FloatArray:
    u, v = rng.uniform(0, 40, (2, count))
    if shape == "plane":
        return np.column_stack([u, v, np.zeros(count)])
    return np.column_stack([u, 5 * np.cos(v), 5 * np.sin(v)])


def rotation(axis: FloatArray, angle: float) -> FloatArray:
    """Return the rotation matrix of an axis and an angle in radians (Rodrigues' formula)."""
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
