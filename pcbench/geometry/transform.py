"""Similarity and affine transforms of 3-D points, their fits to pairs of points, and their text format."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError, reason_of
from pcbench.geometry.arrays import MAX_COORDINATE, FloatArray
from pcbench.regular_files import read_text

_MAX_REWEIGHTINGS = 30
_MAX_ROTATION_ERROR = 1e-6  # of products of rows: accepts rotation matrices printed with seven digits


class Motion(NamedTuple):
    """A similarity described at one point: the shift of that point, and the rotation and scale about it.

    Attributes:
        shift: (3,) displacement of the point.
        angle_deg: rotation angle in degrees, from 0 to 180.
        axis: (3,) unit axis of the counter-clockwise rotation; None if there is no rotation.
        scale: positive scale factor.
    """

    shift: FloatArray
    angle_deg: float
    axis: FloatArray | None
    scale: float


@dataclass(frozen=True, eq=False)
class Affine:
    """The map x -> linear @ x + translation, with an invertible (3, 3) linear part.

    Raises:
        InputError: a shape is wrong, a number is not finite, or the linear part is singular.
    """

    linear: FloatArray
    translation: FloatArray

    def __post_init__(self) -> None:
        linear = np.array(self.linear, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64)
        if linear.shape != (3, 3) or translation.shape != (3,):
            raise InputError(
                f"expected a (3, 3) matrix and a (3,) translation, got {linear.shape}, {translation.shape}"
            )
        if not (np.isfinite(linear).all() and np.isfinite(translation).all()):
            raise InputError("expected a transform of finite numbers, got NaN or Inf")
        stretch = np.linalg.svd(linear, compute_uv=False)
        if not stretch[2] > 1e-12 * stretch[0]:  # the inverse has the same ratio, so it is accepted too
            raise InputError("expected an invertible transform, got a singular matrix")
        object.__setattr__(self, "linear", linear)
        object.__setattr__(self, "translation", translation)

    @property
    def matrix(self) -> FloatArray:
        """The homogeneous (4, 4) matrix."""
        return _homogeneous_matrix(self.linear, self.translation)

    def apply(self, points: FloatArray) -> FloatArray:
        """Return transformed points (N, 3)."""
        return _multiply_rows(self.linear, points) + self.translation

    def apply_normals(self, normals: FloatArray) -> FloatArray:
        """Return normals (N, 3) transformed by the inverse transpose, with their lengths preserved."""
        moved = _multiply_rows(self.inverse().linear.T, normals)
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        lengths_before = np.linalg.norm(normals, axis=1, keepdims=True)
        scaled: FloatArray = np.divide(moved * lengths_before, length, out=np.zeros_like(moved), where=length > 0)
        return scaled

    def inverse(self) -> Affine:
        """Return the inverse map."""
        linear: FloatArray = np.linalg.inv(self.linear).astype(np.float64)
        return Affine(linear, -linear @ self.translation)

    def __matmul__(self, other: Affine | Similarity) -> Affine:
        """`self @ other` applies `other` first."""
        m = self.matrix @ other.matrix
        return Affine(m[:3, :3], m[:3, 3])


@dataclass(frozen=True, eq=False)
class Similarity:
    """The map x -> scale * rotation @ x + translation, with scale > 0 and a proper (3, 3) rotation.

    Raises:
        InputError: a shape is wrong, a number is not finite or out of range, or the rotation is not orthonormal.
    """

    rotation: FloatArray
    translation: FloatArray
    scale: float = 1.0

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise InputError(
                f"expected a (3, 3) rotation and a (3,) translation, got {rotation.shape}, {translation.shape}"
            )
        # ICP creates thousands of transforms: for so few numbers Python's operations are faster than numpy's.
        entries, shifts = rotation.ravel().tolist(), translation.tolist()
        if not all(map(math.isfinite, entries + shifts)):
            raise InputError("expected a transform of finite numbers, got NaN or Inf")
        if (largest := max(map(abs, shifts))) > MAX_COORDINATE:
            raise InputError(f"expected a translation up to {MAX_COORDINATE:g}, got {largest:g}")
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"expected a positive scale, got {self.scale}")
        if not 1 / MAX_COORDINATE <= self.scale <= MAX_COORDINATE:
            raise InputError(f"expected a scale of {1 / MAX_COORDINATE:g} to {MAX_COORDINATE:g}, got {self.scale:g}")
        if not _is_rotation(*entries):
            raise InputError("expected a rotation matrix: orthonormal rows and determinant +1")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)
        object.__setattr__(self, "scale", float(self.scale))

    @classmethod
    def identity(cls) -> Similarity:
        """Return the identity."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Similarity:
        """Return the similarity of a homogeneous (4, 4) matrix.

        Raises:
            InputError: the matrix is not a rotation times a positive scale (use `Affine` for shear and reflections).
        """
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape != (4, 4):
            raise InputError(f"expected a 4x4 matrix, got shape {m.shape}")
        if not np.isfinite(m).all():
            raise InputError("expected a transform of finite numbers, got NaN or Inf")
        if (largest := np.abs(m).max()) > MAX_COORDINATE:
            raise InputError(f"expected a matrix of numbers up to {MAX_COORDINATE:g}, got {largest:g}")
        if not np.allclose(m[3], [0, 0, 0, 1], rtol=0, atol=1e-9):
            raise InputError(f"expected the last row 0 0 0 1, got {' '.join(f'{v:g}' for v in m[3])}")
        determinant = np.linalg.det(m[:3, :3])
        if determinant < 0:
            raise InputError(
                f"expected a rotation with a positive scale, got a reflection (determinant {determinant:g}): the matrix"
                " mirrors the candidate; undo the reflection in the matrix, or of the cloud (`pcbench convert CANDIDATE"
                " unmirrored.ply --mirror x`, or y, z, xy, xz, yz)"
            )
        if not determinant > 0:
            raise InputError(f"expected a rotation with a positive scale, got determinant {determinant:g}")
        scale = float(np.cbrt(determinant))
        if abs(scale - 1) < 1e-9:  # rounding of the cube root
            scale = 1.0
        return cls(m[:3, :3] / scale, m[:3, 3], scale)

    @property
    def linear(self) -> FloatArray:
        """The linear part (3, 3): scale * rotation."""
        return self.scale * self.rotation

    @property
    def matrix(self) -> FloatArray:
        """The homogeneous (4, 4) matrix."""
        return _homogeneous_matrix(self.linear, self.translation)

    def apply(self, points: FloatArray) -> FloatArray:
        """Return transformed points (N, 3)."""
        return _multiply_rows(self.linear, points) + self.translation

    def apply_normals(self, normals: FloatArray) -> FloatArray:
        """Return rotated normals (N, 3)."""
        return _multiply_rows(self.rotation, normals)

    def inverse(self) -> Similarity:
        """Return the inverse map."""
        return Similarity(self.rotation.T, -(self.rotation.T @ self.translation) / self.scale, 1.0 / self.scale)

    def __matmul__(self, other: Similarity) -> Similarity:
        """`self @ other` applies `other` first."""
        # Rounding in long products makes rotations lose orthonormality; the orthogonal polar factor restores it.
        u, _, vt = np.linalg.svd(self.rotation @ other.rotation)
        return Similarity(
            u @ vt,
            self.scale * (self.rotation @ other.translation) + self.translation,
            self.scale * other.scale,
        )

    def about(self, origin: FloatArray) -> Similarity:
        """Return the same motion for original coordinates, if this one was fitted after subtracting `origin` (3,)."""
        return Similarity(self.rotation, self.translation + origin - self.linear @ origin, self.scale)

    def motion_at(self, position: ArrayLike) -> Motion:
        """Return the motion of the transform about a position (3,).

        It is easier to interpret than the matrix, whose translation is that of the origin, far from most clouds.
        """
        position = np.asarray(position, np.float64)
        angle, axis = _angle_and_axis(self.rotation)
        return Motion(self.apply(position[None])[0] - position, float(np.degrees(angle)), axis, self.scale)


def _is_rotation(*entries: float) -> bool:
    """Return whether the nine entries of a matrix, row by row, are those of a rotation, up to rounding."""
    a, b, c, d, e, f, g, h, i = entries
    lengths = (a * a + b * b + c * c - 1, d * d + e * e + f * f - 1, g * g + h * h + i * i - 1)
    angles = (a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i)
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    return max(map(abs, lengths + angles)) <= _MAX_ROTATION_ERROR and determinant > 0


def _angle_and_axis(rotation: FloatArray) -> tuple[float, FloatArray | None]:
    """Return the rotation angle in radians, from 0 to pi, and the unit axis (3,), or None for no rotation.

    The unit quaternion is exact for small angles and for half turns (Shepperd 1978, "Quaternion from rotation matrix").
    """
    r, trace = rotation, np.trace(rotation)
    squares = np.array([1 + trace, *(1 - trace + 2 * np.diag(r))])  # (2w)^2, (2x)^2, ...: the largest selects the row
    largest = int(np.argmax(squares))
    if largest == 0:
        quaternion = np.array([squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    else:
        i, j, k = largest - 1, largest % 3, (largest + 1) % 3
        quaternion = np.empty(4)
        quaternion[0], quaternion[1 + i] = r[k, j] - r[j, k], squares[largest]
        quaternion[1 + j], quaternion[1 + k] = r[j, i] + r[i, j], r[k, i] + r[i, k]
    quaternion /= np.linalg.norm(quaternion)
    sine = float(np.linalg.norm(quaternion[1:]))
    if sine < 1e-12:  # rounding determines no axis
        return 0.0, None
    axis: FloatArray = quaternion[1:] * (1 if quaternion[0] >= 0 else -1) / sine
    return 2 * math.atan2(sine, abs(float(quaternion[0]))), axis


def _homogeneous_matrix(linear: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the homogeneous matrix (4, 4) of x -> linear (3, 3) @ x + translation (3,)."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = linear, translation
    return result


def _multiply_rows(matrix: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return matrix (3, 3) times each of vectors (N, 3)."""
    # einsum does not use BLAS, so the result does not depend on the number of threads.
    products: FloatArray = np.einsum("nj,ij->ni", vectors, matrix)
    return products


def cross_matrix(vector: FloatArray) -> FloatArray:
    """Return the matrix (3, 3) of the cross product of a vector (3,) with others."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_about(axis: FloatArray, angle_rad: float) -> FloatArray:
    """Return the rotation matrix (3, 3) of a unit axis (3,) and an angle (Rodrigues)."""
    cross = cross_matrix(axis)
    rotation: FloatArray = np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * (cross @ cross)
    return rotation


def rotation_from_vector(vector: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) of a rotation vector (3,), whose length is the angle in radians."""
    angle_rad = float(np.linalg.norm(vector))
    return np.eye(3) if angle_rad < 1e-300 else rotation_about(vector / angle_rad, angle_rad)


def fit_similarity(
    candidate: FloatArray, reference: FloatArray, *, with_scale: bool = True, weights: FloatArray | None = None
) -> Similarity:
    """Fit the least-squares similarity, or rigid motion, that maps candidate (N, 3) onto reference (N, 3) points.

    Umeyama 1991, eqs. 38-43: the rotation from the SVD of the cross-covariance with its reflection correction, then the
    scale, then the translation. This order matters: a translation from before the correction is wrong for planar sets.

    Args:
        candidate: points (N, 3) to be moved.
        reference: points (N, 3) to be matched, row by row.
        with_scale: whether a scale is estimated; otherwise it is 1.
        weights: nonnegative weights (N,); None for equal weights.

    Raises:
        InputError: there are fewer than three pairs, or all candidate or all reference points lie on one line.
    """
    candidate, reference = np.asarray(candidate, np.float64), np.asarray(reference, np.float64)
    if candidate.shape != reference.shape or candidate.ndim != 2 or candidate.shape[1] != 3:
        raise InputError(f"expected two (N, 3) arrays of pairs, got {candidate.shape} and {reference.shape}")
    if len(candidate) < 3:
        raise InputError(f"expected at least 3 pairs of points to fit a transform, got {len(candidate)}")
    if not (np.abs(candidate).max() <= MAX_COORDINATE and np.abs(reference).max() <= MAX_COORDINATE):
        raise InputError(f"expected finite coordinates up to {MAX_COORDINATE:g} in the pairs of points")
    w = np.full(len(candidate), 1 / len(candidate)) if weights is None else weights / weights.sum()
    mean_c, mean_r = np.einsum("n,ni->i", w, candidate), np.einsum("n,ni->i", w, reference)
    c, r = candidate - mean_c, reference - mean_r
    covariance = np.einsum("ni,n,nj->ij", r, w, c)  # eq. 38
    variances = np.linalg.eigvalsh(np.einsum("ni,n,nj->ij", c, w, c))
    # Eigenvalues are squared lengths; rounding leaves about 1e-16 of the largest in place of zero.
    u, singular, vt = np.linalg.svd(covariance)
    # The covariance has rank one if either set lies on a line.
    if variances[1] <= 1e-14 * variances[2] or singular[1] <= 1e-14 * singular[0]:
        raise InputError("expected pairs that span a plane, got points on one line: the rotation is not determined")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])  # eq. 43
    rotation = (u * sign) @ vt  # eq. 40
    scale = float((singular * sign).sum() / variances.sum()) if with_scale else 1.0  # eq. 42
    return Similarity(rotation, mean_r - scale * rotation @ mean_c, scale)  # eq. 41


def robust_similarity(candidate: FloatArray, reference: FloatArray, *, with_scale: bool = True) -> Similarity:
    """Fit the similarity, or rigid motion, that maps candidate (N, 3) onto reference (N, 3) points despite outliers.

    Iteratively reweighted least squares with weights 1 / max(residual, median residual). Beyond the median, an error
    contributes linearly and not quadratically (Huber 1964 with a data-driven scale), so no metric threshold is needed.

    Args:
        candidate: points (N, 3) to be moved.
        reference: points (N, 3) to be matched, row by row.
        with_scale: whether a scale is estimated; otherwise it is 1.

    Raises:
        InputError: there are fewer than three pairs, or the points lie on one line.
    """
    fit = fit_similarity(candidate, reference, with_scale=with_scale)
    for _ in range(_MAX_REWEIGHTINGS):
        residuals = np.linalg.norm(fit.apply(candidate) - reference, axis=1)
        scale = float(np.median(residuals))
        if scale <= 1e-12 * float(np.abs(reference).max(initial=1)):  # exact up to rounding
            break
        fit = fit_similarity(candidate, reference, with_scale=with_scale, weights=1 / np.maximum(residuals, scale))
    return fit


def read_matrix(path: str | Path) -> Similarity:
    """Read a 4x4 (or 3x4) matrix of a similarity from a text file; text after # is a comment.

    Raises:
        InputError: the file does not contain such a matrix.
    """
    try:
        text = read_text(path)
    except (InputError, OSError) as error:
        raise InputError(f"{path}: cannot read a matrix: {reason_of(error)}") from error
    rows = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
    values: list[list[float]] = []
    for row in filter(None, rows):
        try:
            values.append([float(word) for word in row])
        except ValueError:
            raise InputError(
                f"{path}: expected a 4x4 matrix of numbers, got the line {' '.join(row)[:40]!r}: give a file as written"
                " by --matrix"
            ) from None
    shape = (len(values), len(values[0]) if values else 0)
    if shape not in ((4, 4), (3, 4)) or any(len(row) != 4 for row in values):
        raise InputError(
            f"{path}: expected 3 or 4 rows of 4 numbers, got {len(values)} rows of {[len(r) for r in values][:5]}"
        )
    try:
        return Similarity.from_matrix(np.array([*values, [0.0, 0.0, 0.0, 1.0]][:4]))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def format_matrix(transform: Similarity | Affine) -> str:
    """Format the 4x4 matrix of a transform as text.

    `read_matrix` restores a rigid motion exactly. A scale other than 1 is divided out of the matrix, which rounds the
    last digit.
    """
    return "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in transform.matrix)
