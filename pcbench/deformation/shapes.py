"""The shape of a deformation in a word, with its figures: dome, bowl, saddle, S-bend, twist, stretch or growth."""

from __future__ import annotations

import numpy as np

from pcbench.deformation.parts import Field, Shape, ShapeFigure
from pcbench.geometry.arrays import FloatArray

_MIN_SHARE = 0.7  # share of the mean squared displacement that a shape explains; below it, the field has no simple one
_SIMPLER = 0.02  # share of the mean squared displacement that each further parameter has to explain
_MIN_CELLS = 12
_END_SHARE = 0.1  # share of the surface in the centre, at the edge, at the bottom and at the top


def shape_of(field: Field) -> Shape | None:
    """Return the shape that explains a displacement field best; None if it has no simple shape.

    The field is compared along all axes, over the cells, beyond any rigid motion.
    """
    seen = np.isfinite(field.displacements).all(axis=1) & (field.counts > 0)
    if np.count_nonzero(seen) < _MIN_CELLS:
        return None
    weights = field.counts[seen].astype(np.float64)
    centred = field.places[seen] - np.average(field.places[seen], axis=0, weights=weights)
    size = float(np.abs(centred).max())
    if size == 0:
        return None
    places, observed = centred / size, field.displacements[seen]
    root = np.sqrt(weights)[:, None, None]
    rigid = (root * _rigid_columns(places)).reshape(3 * len(places), -1)
    displacements = (root[:, 0] * observed).ravel()
    displacements = displacements - rigid @ np.linalg.lstsq(rigid, displacements, rcond=1e-9)[0]
    power = float(displacements @ displacements)
    if power == 0:
        return None
    best = None
    for name, columns in _shapes(places).items():
        matrix = (root * columns).reshape(3 * len(places), -1)
        matrix = matrix - rigid @ np.linalg.lstsq(rigid, matrix, rcond=1e-9)[0]
        explained = matrix @ np.linalg.lstsq(matrix, displacements, rcond=1e-6)[0]
        share = float(explained @ explained) / power
        if best is None or share - _SIMPLER * matrix.shape[1] > best[0] - _SIMPLER * best[2]:
            best = share, name, matrix.shape[1]
    if best is None or best[0] < _MIN_SHARE:
        return None
    figures = _figures(best[1], places, observed, weights)
    name = best[1]
    if name == "dome" and figures[0].value < figures[1].value:
        name = "bowl"
    return Shape(name, best[0], figures)


def _rigid_columns(places: FloatArray) -> FloatArray:
    """Return displacements (N, 3, 6) by translations and small rotations."""
    turns = [np.cross(axis, places) for axis in np.eye(3)]
    return np.stack([*(np.tile(axis, (len(places), 1)) for axis in np.eye(3)), *turns], axis=2)


def _shapes(places: FloatArray) -> dict[str, FloatArray]:
    """Return the displacements (N, 3, P) that span each shape."""
    x, y, z = places.T
    zero = np.zeros(len(places))
    squared = x**2 + y**2

    def vertical(*values: FloatArray) -> FloatArray:
        return np.stack([np.stack([zero, zero, value], axis=1) for value in values], axis=2)

    def horizontal(*values: tuple[FloatArray, FloatArray]) -> FloatArray:
        return np.stack([np.stack([along_x, along_y, zero], axis=1) for along_x, along_y in values], axis=2)

    return {
        "dome": vertical(squared),
        "saddle": vertical(x**2 - y**2, x * y),
        "S-bend": vertical(x**3, x**2 * y, x * y**2, y**3),
        "twist": horizontal((-y * x, x * x), (-y * y, x * y), (-y * z, x * z)),
        "growth with distance": horizontal((x, y), (x * squared, y * squared)),
        "growth with height": np.concatenate([vertical(z, z**2), horizontal((z**2, zero), (zero, z**2))], axis=2),
        "stretch or shear": horizontal((x, zero), (zero, y), (y, x)),
    }


def _figures(name: str, places: FloatArray, moved: FloatArray, weights: FloatArray) -> tuple[ShapeFigure, ShapeFigure]:
    """Return mean displacements at both ends of a shape: vertical ones of domes, else of the axis that moved most."""
    axis = 2 if name in ("dome", "saddle", "S-bend") else int(np.argmax(weights @ np.square(moved)))
    if name in ("dome", "growth with distance"):
        along, ends = np.hypot(*places[:, :2].T), ("in the centre", "at the edge")
    elif name == "growth with height":
        along, ends = places[:, 2], ("at the bottom", "at the top")
    else:
        along, ends = moved[:, axis], ("at one end", "at the other")
    if name == "growth with distance":
        values = np.einsum("ni,ni->n", moved[:, :2], places[:, :2]) / np.maximum(along, 1e-12)
    else:
        values = moved[:, axis]
    order = np.argsort(along, kind="stable")
    share = np.cumsum(weights[order]) / weights.sum()
    inner, outer = order[share <= max(_END_SHARE, share[0])], order[share >= 1 - _END_SHARE]
    first, last = (float(np.average(values[rows], weights=weights[rows])) for rows in (inner, outer))
    return ShapeFigure(ends[0], first), ShapeFigure(ends[1], last)
