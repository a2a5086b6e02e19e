"""What arrays are called here, what a caller may give as one, how far coordinates go, and who may change them."""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_Array = TypeVar("_Array", bound=NDArray[Any])

MAX_COORDINATE = 1e100  # squared distances between coordinates beyond it overflow
_ROUNDINGS = 16  # in the last digit of a coordinate


def rounding_of(points: FloatArray, origin: FloatArray) -> float:
    """A length that coordinates of points (N, 3) plus an origin (3,) are surely rounded by, after a few operations."""
    largest = max(float(np.abs(corner + origin).max()) for corner in bounds(points))
    return _ROUNDINGS * float(np.finfo(np.float64).eps) * largest


def bounds(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner (3,) of points (N, 3), N >= 1."""
    # One axis at a time: several times faster than numpy's reduction of rows of three.
    columns = [points[:, axis] for axis in range(3)]
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


def as_rows(what: str, data: ArrayLike) -> FloatArray:
    """Points or directions that a caller gave, as C-contiguous float64 (N, 3): its own array where that is one.

    Raises:
        InputError: it is no plain array of real numbers, or has another shape. `what` names it in the message.
    """
    kind = getattr(getattr(data, "dtype", None), "kind", "f")
    if isinstance(data, np.ma.MaskedArray) or kind not in "fiub":
        raise InputError(f"expected {what} as a plain array of real numbers, got {type(data).__name__}")
    try:
        array = np.ascontiguousarray(data, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"expected {what} as an (N, 3) array of numbers, got {type(data).__name__}") from error
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"expected {what} of shape (N, 3), got {array.shape}")
    return array


def freeze(array: _Array) -> _Array:
    """The same array, read-only from now on: one that was just made and is handed over can be kept without a copy."""
    part: Any = array
    while isinstance(part, np.ndarray):  # a view is frozen with what it looks at
        part.flags.writeable = False
        part = part.base
    return array


def is_frozen(array: NDArray[Any]) -> bool:
    """Whether no array, neither this one nor what it is a view of, gives leave to change its numbers."""
    part: Any = array
    while isinstance(part, np.ndarray):
        if part.flags.writeable:
            return False
        part = part.base
    return part is None or isinstance(part, bytes)


def kept(array: _Array, given: Any) -> _Array:
    """An array that its giver cannot change: itself where it is frozen or was converted from `given`, else a copy."""
    converted = isinstance(given, np.ndarray | list | tuple) and array is not given and array.base is None
    return array if is_frozen(array) else freeze(array if converted else array.copy())
