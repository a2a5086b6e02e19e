"""Record settings in settings.json so that they repeat a comparison bit for bit, even if they were given as objects.

A text is kept. A method or a region from a file becomes its text, with an absolute path, and a registration method that
a text describes completely becomes that text. Another object becomes `{"type": NAME}` with its fields and all digits of
its numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.regions import Box, Polygon, Sphere, Union
from pcbench.geometry.transform import Similarity
from pcbench.measure.m3c2_settings import M3C2Settings
from pcbench.measure.presets import ALWAYS
from pcbench.measure.settings import Settings
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.registration import (
    METHODS,
    ControlPoints,
    FeatureSettings,
    GivenPose,
    IcpSettings,
    TrajectorySettings,
    parse_method,
)
from pcbench.registration.given import absolute_text

_TYPES: dict[str, type[Any]] = {
    cls.__name__: cls
    for cls in (
        *(IcpSettings, FeatureSettings, ControlPoints, TrajectorySettings, GivenPose, Similarity),
        *(Box, Sphere, Polygon, Union, Cloud),
    )
}
# Settings of tiles that are recorded, with their JSON types.
_TILING_KINDS: dict[str, Any] = {
    "tile_points": int | None,
    "max_distance": float | int | None,
    "skip_bad": bool,
}


def record(settings: Settings) -> dict[str, Any]:
    """Return settings as JSON values; `restore` returns equal settings."""
    values = {item.name: getattr(settings, item.name) for item in fields(settings)}
    for name in settings.unset:
        del values[name]
    if settings.initial is None:
        del values["initial"]
    if isinstance(m3c2 := values.pop("m3c2"), M3C2Settings):
        values["m3c2"] = _m3c2_record(m3c2)
    return {name: _to_record(value) for name, value in values.items()}


def restore(values: Mapping[str, Any]) -> Settings:
    """Return the settings from values of `record`.

    Raises:
        InputError, AttributeError, KeyError, TypeError, ValueError: the values are damaged.
    """
    restored = {name: _from_record(value) for name, value in values.items()}
    restored["presets"] = tuple(name for name in restored.get("presets", ()) if name not in ALWAYS)
    if isinstance(values.get("m3c2"), Mapping):
        restored["m3c2"] = M3C2Settings(**{name: _from_record(value) for name, value in values["m3c2"].items()})
    return Settings(**restored)


def record_tiling(tiling: TilingSettings) -> dict[str, Any]:
    """Return the settings of a tiled comparison as JSON values, without those of the machine, such as its memory."""
    return {name: getattr(tiling, name) for name in _TILING_KINDS}


def restore_tiling(values: Any) -> TilingSettings:
    """Return the settings from values of `record_tiling`.

    Raises:
        InputError, ValueError: the values are damaged.
    """
    if not isinstance(values, Mapping) or not values.keys() <= _TILING_KINDS.keys():
        raise ValueError(f"expected 'tiling' with {', '.join(_TILING_KINDS)}, got {values!r}")
    for name, value in values.items():
        if not isinstance(value, _TILING_KINDS[name]) or (isinstance(value, bool) and name != "skip_bad"):
            raise ValueError(f"expected another value of {name!r} in 'tiling' than {value!r}")
    return TilingSettings(**values)


def _to_record(value: Any) -> Any:
    if getattr(value, "files", ()):  # a registration method
        return absolute_text(value.text)
    if (file := getattr(value, "file", None)) is not None:  # a region
        return f"{value.text.partition(':')[0]}:{file.absolute()}"
    if isinstance(value, IcpSettings | FeatureSettings) and value.text in METHODS and parse_method(value.text) == value:
        return value.text
    if type(value).__name__ in _TYPES and is_dataclass(value):
        recorded = {item.name: _to_record(getattr(value, item.name)) for item in fields(value) if item.init}
        return {"type": type(value).__name__, **recorded}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: _to_record(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_record(item) for item in value]
    return getattr(value, "text", value)  # a user-defined region has only its text


def _m3c2_record(settings: M3C2Settings) -> Any:
    if not isinstance(settings.cores, Cloud):
        return settings.absolute().text
    return {item.name: _to_record(getattr(settings, item.name)) for item in fields(settings)}


def _from_record(value: Any) -> Any:
    """Restore a value; fields that are null in JSON (non-finite numbers) get their defaults."""
    if isinstance(value, Mapping) and "type" in value:
        arguments = {name: _from_record(item) for name, item in value.items() if name != "type" and item is not None}
        return _TYPES[value["type"]](**arguments)
    if isinstance(value, Mapping):
        return {name: _from_record(item) for name, item in value.items()}
    return tuple(_from_record(item) for item in value) if isinstance(value, list) else value
