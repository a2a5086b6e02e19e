"""Array types, conversion of callers' data, the largest supported coordinate, and read-only arrays."""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError
from pcbench.native import _core

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_Array = TypeVar("_Array", bound=NDArray[Any])

MAX_COORDINATE = 1e100  # keeps squared distances, and products of three lengths, far below overflow
_ROUNDING_ULPS = 16  # rounding error of a few operations, in units in the last place of the largest coordinate


def rounding_bound(points: FloatArray, origin: FloatArray) -> float:
    """Upper bound of the rounding error of points (N, 3) plus an origin (3,) after a few operations, as a length."""
    largest = max(float(np.abs(corner + origin).max()) for corner in bounds(points))
    return _ROUNDING_ULPS * float(np.finfo(np.float64).eps) * largest


def bounds(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner (3,) of points (N, 3), N >= 1; NaN where a coordinate is NaN."""
    lower, upper = np.empty(3), np.empty(3)
    _core.bounds(np.ascontiguousarray(points, np.float64), lower, upper)
    return lower, upper


def even_rows(count: int, most: int) -> IntArray:
    """Return at most `most` of the rows 0 to `count` - 1 at even steps, the first and the last included."""
    if count <= most:
        return np.arange(count)
    return np.linspace(0, count - 1, most).round().astype(np.int64)


def random_rows(points: FloatArray, count: int) -> FloatArray:
    """Return `count` of the points (N, 3) at random, in random order, the same in each run; all if there are fewer."""
    if len(points) <= count:
        return np.random.default_rng(0).permutation(points)
    return points[np.random.default_rng(0).choice(len(points), count, replace=False)]


def as_rows(name: str, data: ArrayLike) -> FloatArray:
    """Return a caller's points or directions as a C-contiguous float64 array (N, 3), copied only if needed.

    Args:
        name: name of the data in error messages.
        data: array-like (N, 3) of real numbers.

    Raises:
        InputError: `data` is not a plain array of real numbers, or does not have the shape (N, 3).
    """
    kind = getattr(getattr(data, "dtype", None), "kind", "f")
    if isinstance(data, np.ma.MaskedArray) or kind not in "fiub":
        raise InputError(f"expected {name} as a plain array of real numbers, got {type(data).__name__}")
    try:
        array = np.ascontiguousarray(data, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"expected {name} as an (N, 3) array of numbers, got {type(data).__name__}") from error
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"expected {name} of shape (N, 3), got {array.shape}")
    return array


def freeze(array: _Array) -> _Array:
    """Make an array and the arrays that it is a view of read-only, and return it. Use it on arrays just created."""
    part: Any = array
    while isinstance(part, np.ndarray):  # a view stays writable through its base
        part.flags.writeable = False
        part = part.base
    return array


def is_frozen(array: NDArray[Any]) -> bool:
    """Return whether neither the array nor any array that it is a view of is writable."""
    part: Any = array
    while isinstance(part, np.ndarray):
        if part.flags.writeable:
            return False
        part = part.base
    return part is None or isinstance(part, bytes)


def as_frozen(array: _Array, original: Any) -> _Array:
    """Return a read-only array that the caller cannot change.

    This is `array` itself if it is frozen or newly converted from `original`, else a copy.
    """
    converted = isinstance(original, np.ndarray | list | tuple) and array is not original and array.base is None
    return array if is_frozen(array) else freeze(array if converted else array.copy())
