"""One surface, sampled in many ways: strewn points, copies of points, overlapping strips, scan lines, densities."""

import numpy as np
from shapes import terrain_height

SIZE = 40.0
COPIES = ("exactly twice", "twice", "twice, loosely", "40 % twice", "five times")
LINES = ("lines 10:1", "lines 25:1", "lines 50:1", "lines 25:1, twice")
KINDS = ("strewn", *COPIES, "strips", *LINES, "1:1000")
_APART = 2.5e-4  # per axis: copies are 0.4 mm apart


def sampled(kind: str, count: int = 8_000, seed: int = 0) -> np.ndarray:
    """Return points (N, 3) of `shapes.terrain` over [0, SIZE]^2, as one of `KINDS`; N may exceed `count`."""
    rng = np.random.default_rng(seed)
    strewn = _on_surface(rng.uniform(0, SIZE, (count, 2)))
    match kind:
        case "strewn":
            return strewn
        case "exactly twice":
            return np.concatenate([strewn, strewn])
        case "twice":
            return _with_copies(strewn, strewn, _APART, rng)
        case "twice, loosely":  # by 0.3 of the spacing
            return _with_copies(strewn, strewn, 0.3 * 0.47 * SIZE / np.sqrt(count) / np.sqrt(3), rng)
        case "40 % twice":
            return _with_copies(strewn, strewn[: int(0.4 * count)], _APART, rng)
        case "five times":
            return _with_copies(strewn, np.tile(strewn, (4, 1)), _APART, rng)
        case "strips":  # of which the halves overlap
            x, y = rng.uniform(0, SIZE, (2, count))
            halves = [_on_surface(np.column_stack([x * 2 / 3 + start, y])) for start in (0, SIZE / 3)]
            return np.concatenate(halves)
        case "1:1000":
            x = SIZE * (1 - np.log10(1 + 999 * rng.uniform(0, 1, count)) / 3)
            return _on_surface(np.column_stack([x, rng.uniform(0, SIZE, count)]))
    ratio = int(kind.removeprefix("lines ").split(":")[0])
    lines = round(np.sqrt(count / ratio))
    x, y = np.meshgrid((np.arange(lines) + 0.5) * SIZE / lines, np.arange(lines * ratio) * SIZE / (lines * ratio))
    plane = np.column_stack([x.ravel(), y.ravel()])
    scanned = _on_surface(plane + rng.normal(0, 0.1 * SIZE / (lines * ratio), plane.shape))
    return _with_copies(scanned, scanned, 1e-4, rng) if kind.endswith("twice") else scanned


def _on_surface(plane: np.ndarray) -> np.ndarray:
    return np.column_stack([plane, terrain_height(*plane.T)])


def _with_copies(points: np.ndarray, copied: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([points, copied + rng.normal(0, sigma, copied.shape)])
