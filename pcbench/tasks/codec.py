"""Values as JSON and arrays: a form on disk that holds no code, unlike a pickle.

None, booleans, numbers and texts are themselves in JSON; every other value is a list that starts with its kind. Arrays
are stored in numpy's format. Objects of frozen types are stored by their fields, and read only if the reader names the
type, so that a file cannot choose what is called.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache, partial
from math import prod
from pathlib import Path, PurePath
from tokenize import TokenError
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, Protocol, get_args, get_type_hints

if TYPE_CHECKING:  # workers limit the threads of numpy before they import it
    from numpy.typing import NDArray


class Writable(Protocol):
    """A binary file, or a hash of what is written to one."""

    def write(self, data: Any, /) -> object:
        """Write the bytes of an object with a contiguous buffer."""


class Encoded(NamedTuple):
    """A value as JSON, and the arrays to which it refers by their numbers."""

    tree: Any
    arrays: list[NDArray[Any]]


def encode(value: object) -> Encoded:
    """Return the form of a value.

    Args:
        value: None, a boolean, number, text, bytes, path, numpy scalar or array; a list, tuple or mapping of these;
            or an object of a data class or named tuple with such fields.

    Raises:
        TypeError: it has another type, or an array of objects.
    """
    arrays: list[NDArray[Any]] = []
    return Encoded(_encode(value, arrays), arrays)


def _encode(value: object, arrays: list[NDArray[Any]]) -> Any:
    import numpy as np

    inner = partial(_encode, arrays=arrays)
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, (np.ndarray, np.generic)):
        return ["array" if isinstance(value, np.ndarray) else "scalar", _number_of(np.asarray(value), arrays)]
    if isinstance(value, bytes):
        return ["bytes", _number_of(np.frombuffer(value, np.uint8), arrays)]
    if isinstance(value, PurePath):
        return ["path", str(value)]
    if (names := _fields_of(type(value))) is not None:
        return ["type", _name_of(type(value)), {name: inner(getattr(value, name)) for name in names}]
    if type(value) in (list, tuple):
        assert isinstance(value, Sequence)
        return [type(value).__name__, [inner(item) for item in value]]
    if isinstance(value, Mapping):
        return ["dict", [[inner(key), inner(item)] for key, item in value.items()]]
    raise TypeError(f"expected a value that can be stored without code, got {type(value).__name__}")


def _number_of(array: NDArray[Any], arrays: list[NDArray[Any]]) -> int:
    if array.dtype.hasobject:
        raise TypeError(f"expected an array of numbers or texts, got {array.dtype}")
    arrays.append(array)
    return len(arrays) - 1


def decode(encoded: Encoded, types: Mapping[str, type]) -> Any:
    """Return the value of which this is the form.

    Args:
        encoded: form of a value.
        types: the types that its objects may have, by name, see `types_in`.

    Raises:
        ValueError: it is not the form of a value with these types.
    """
    try:
        return _decode(encoded.tree, encoded.arrays, types)
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"expected a stored value: {type(error).__name__}: {error}") from error


def _decode(tree: Any, arrays: Sequence[NDArray[Any]], types: Mapping[str, type]) -> Any:
    if not isinstance(tree, list):
        return tree
    inner = partial(_decode, arrays=arrays, types=types)
    kind, content = tree[0], tree[1]
    match kind:
        case "array":
            return arrays[content]
        case "scalar":
            return arrays[content][()]
        case "bytes":
            return arrays[content].tobytes()
        case "path":
            return Path(content)
        case "type":
            return types[content](**{name: inner(item) for name, item in tree[2].items()})
        case "list":
            return [inner(item) for item in content]
        case "tuple":
            return tuple(inner(item) for item in content)
        case "dict":
            return {inner(key): inner(item) for key, item in content}
    raise ValueError(f"expected a kind of value, got {kind!r}")


def types_in(hint: Any) -> dict[str, type]:
    """Return the data classes and named tuples, by name, that a type consists of, such as that of a function's result.

    Args:
        hint: a type as in annotations, with all that its fields are annotated with.
    """
    types: dict[str, type] = {}
    pending = [hint]
    while pending:
        part = pending.pop()
        pending += get_args(part)
        if isinstance(part, type) and _fields_of(part) is not None and _name_of(part) not in types:
            types[_name_of(part)] = part
            pending += _field_types(part)
    return types


@cache
def _field_types(kind: Any) -> tuple[Any, ...]:
    return tuple(get_type_hints(kind).values())


def result_type(function: Callable[..., Any]) -> Any:
    """Return the type that a function's annotation states for its result; None if it states none."""
    plain = function.func if isinstance(function, partial) else function
    return get_type_hints(plain).get("return")


def fingerprint(value: object) -> str:
    """Return the SHA-256 of the form of a value, which is the same in all processes.

    Raises:
        TypeError: see `encode`.
    """
    tree, arrays = encode(value)
    total = hashlib.sha256(as_json(tree))
    for array in arrays:
        write_array(_Hash(total), array)
    return total.hexdigest()


class _Hash:
    def __init__(self, total: Any) -> None:
        self.write = total.update


def as_json(tree: Any) -> bytes:
    """Return JSON of a tree of `encode`, on one line."""
    return json.dumps(tree, separators=(",", ":")).encode()


def write_array(file: Writable, array: NDArray[Any]) -> None:
    """Write an array in numpy's format (.npy), without a copy of its values."""
    import numpy as np

    values = np.ascontiguousarray(array).reshape(array.shape)  # `ascontiguousarray` adds an axis to a scalar
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(values))
    file.write(header.getvalue())
    file.write(values.reshape(-1).view(np.uint8).data if values.nbytes else b"")


def read_array(file: BinaryIO) -> NDArray[Any]:
    """Read an array from a file of `write_array`, from its current position.

    Raises:
        ValueError: it is no array of numbers or texts, or states more of them than the file has.
    """
    import numpy as np

    start = file.tell()
    try:
        np.lib.format.read_magic(file)
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    except TokenError as error:
        raise ValueError(f"expected the header of an array: {error}") from error
    if min(shape, default=0) < 0 or prod(shape) * dtype.itemsize > file.seek(0, os.SEEK_END) - start:
        raise ValueError(f"expected an array in the file, got the shape {shape}")
    file.seek(start)
    array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def _fields_of(cls: type) -> tuple[str, ...] | None:
    """Return the names of the fields of a data class or named tuple; None for other types."""
    if is_dataclass(cls):
        return tuple(field.name for field in fields(cls) if field.init)
    return getattr(cls, "_fields", None) if issubclass(cls, tuple) else None


def _name_of(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"
