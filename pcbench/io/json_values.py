"""Frozen types as JSON, and back: the fields of a type are the keys of an object.

Missing and non-finite numbers are null. Reading turns null into NaN where a field has to be a number.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from pcbench.errors import Notice

T = TypeVar("T")
_NOTICES = tuple[Notice, ...]
_CODES = "warning_codes"  # key beside `warnings`, whose values are texts


def to_json(values: Any) -> str:
    """Return a dictionary or a dataclass as JSON text; missing and non-finite values are null."""
    return json.dumps(json_values(values), indent=2, allow_nan=False) + "\n"


def json_values(value: Any) -> Any:
    """Convert numpy values, tuples and dataclasses to JSON values; non-finite numbers become null.

    Fields with the metadata `json=False` are omitted; the keys of those with `flat=True` are in the same object. The
    codes of warnings are written beside their texts.
    """
    if isinstance(value, Notice):
        return value.text
    if is_dataclass(value) and not isinstance(value, type):
        types = _types_of(type(value))
        items: dict[str, Any] = {}
        for name in types:
            items |= (
                (json_values(getattr(value, name)) or {}) if _is_flat(value, name) else {name: getattr(value, name)}
            )
        if types.get("warnings") == _NOTICES:
            items[_CODES] = [notice.code for notice in items["warnings"]]
        return json_values(items)
    if isinstance(value, Mapping):
        return {key: json_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_values(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return json_values(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def from_json(kind: type[T], value: Any) -> T:
    """Convert JSON values to a type: the reverse of `json_values`.

    Args:
        kind: a dataclass or a named tuple, whose fields are of such types, plain ones, tuples or mappings of them, or
            one of these or None. Fields that the values lack have their defaults; further values are ignored.
        value: JSON values.

    Raises:
        KeyError, TypeError, ValueError: the values have another form.
    """
    converted: T = _converted(kind, value)
    return converted


def json_example(kind: Any) -> Any:
    """Return JSON values with the keys of a type, of which all values are null and lists have one entry.

    Args:
        kind: a type as for `from_json`. A mapping, whose keys are data, is null too.
    """
    if get_origin(kind) in (Union, UnionType):
        kind = next(part for part in get_args(kind) if part is not NoneType)
    if isinstance(kind, type) and is_dataclass(kind):
        example: dict[str, Any] = {}
        for name, field_type in _types_of(kind).items():
            example |= json_example(field_type) if _is_flat(kind, name) else {name: json_example(field_type)}
        return example
    if get_origin(kind) is tuple:
        return [json_example(part) for part in get_args(kind) if part is not ...]
    if isinstance(kind, type) and issubclass(kind, tuple):  # a named tuple, which is an array
        return [json_example(part) for part in get_type_hints(kind).values()]
    return "" if kind is str else None


def _converted(kind: Any, value: Any) -> Any:
    if get_origin(kind) in (Union, UnionType):
        if value is None and NoneType in get_args(kind):
            return None
        kind = next(part for part in get_args(kind) if part is not NoneType)
    if kind is Any:
        return value
    if value is None:
        if kind is not float:
            raise ValueError("a value is null")
        return math.nan
    origin, parts = get_origin(kind) or kind, get_args(kind)
    if origin is tuple:
        repeated = parts[1:] == (...,)
        kinds = parts[:1] * len(value) if repeated else parts
        return tuple(_converted(*pair) for pair in zip(kinds, value, strict=True))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {key: _converted(parts[1], item) for key, item in value.items()}
    if is_dataclass(kind):
        return _object(kind, value)
    if isinstance(kind, type) and issubclass(kind, tuple):  # a named tuple, which is an array
        return kind(*(_converted(*pair) for pair in zip(get_type_hints(kind).values(), value, strict=True)))
    return value


def _object(kind: Any, values: Mapping[str, Any]) -> Any:
    types = _types_of(kind)
    if types.get("warnings") == _NOTICES:
        notices = zip(values.get(_CODES, ()), values["warnings"], strict=True)
        values = {**values, "warnings": [{"code": code, "text": text} for code, text in notices]}
    converted = {}
    for name, field_type in types.items():
        if _is_flat(kind, name):
            converted[name] = _flat_object(field_type, values)
        elif name in values or _is_required(kind, name):
            converted[name] = _converted(field_type, values[name])
    return kind(**converted)


def _flat_object(kind: Any, values: Mapping[str, Any]) -> Any:
    """Return an object whose keys are among others; None if it is optional and they have none of its required ones."""
    if NoneType not in get_args(kind):
        return _object(kind, values)
    kind = next(part for part in get_args(kind) if part is not NoneType)
    return (
        _object(kind, values) if any(name in values for name in _types_of(kind) if _is_required(kind, name)) else None
    )


def _is_flat(kind: Any, name: str) -> bool:
    return bool(kind.__dataclass_fields__[name].metadata.get("flat", False))


def _is_required(kind: Any, name: str) -> bool:
    item = kind.__dataclass_fields__[name]
    return item.default is MISSING and item.default_factory is MISSING


@cache
def _types_of(kind: Any) -> dict[str, Any]:
    """Return the type of each field of a dataclass that JSON has."""
    types = get_type_hints(kind)
    return {item.name: types[item.name] for item in fields(kind) if item.metadata.get("json", True)}
