"""Settings as settings.json holds them: with all that repeats a comparison bit for bit, also what was given as objects.

A text stays what it is, but that a file in it is named from the root. An object becomes `{"type": NAME}` with its
fields, numbers in full; a registration that a text names completely becomes that text.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.regions import Box, Polygon, Sphere, Union
from pcbench.geometry.transform import Similarity
from pcbench.io.files import named_file
from pcbench.measure.m3c2_settings import M3C2Settings
from pcbench.measure.settings import Settings
from pcbench.registration import METHODS, ControlPoints, FeatureSettings, GivenPose, IcpSettings, parse_method

_TYPES: dict[str, type[Any]] = {
    cls.__name__: cls
    for cls in (IcpSettings, FeatureSettings, ControlPoints, GivenPose, Similarity, Box, Sphere, Polygon, Union, Cloud)
}


def record(settings: Settings) -> dict[str, Any]:
    """The settings as JSON values from which `restore` makes equal ones."""
    values = {item.name: getattr(settings, item.name) for item in fields(settings)}
    if values["initial"] is None:
        del values["initial"]
    if isinstance(m3c2 := values.pop("m3c2"), M3C2Settings):
        values["m3c2"] = _recorded_m3c2(m3c2)
    return {name: _absolute(value) if isinstance(value, str) else _recorded(value) for name, value in values.items()}


def restore(values: Mapping[str, Any]) -> Settings:
    """The settings that `record` wrote.

    Raises:
        InputError, AttributeError, KeyError, TypeError, ValueError: they are damaged.
    """
    restored = {name: _restored(value) for name, value in values.items()}
    if isinstance(values.get("m3c2"), Mapping):
        restored["m3c2"] = M3C2Settings(**{name: _restored(value) for name, value in values["m3c2"].items()})
    return Settings(**restored)


def _recorded(value: Any) -> Any:
    if isinstance(value, IcpSettings | FeatureSettings) and value.text in METHODS and parse_method(value.text) == value:
        return value.text
    if type(value).__name__ in _TYPES and is_dataclass(value):
        named = {item.name: _recorded(getattr(value, item.name)) for item in fields(value) if item.init}
        if "text" in named:
            named["text"] = _absolute(named["text"])
        return {"type": type(value).__name__, **named}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: _recorded(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_recorded(item) for item in value]
    return getattr(value, "text", value)  # a region of the caller's own can only be named


def _absolute(text: str) -> str:
    file = named_file(text)
    return text if file is None else f"{text.partition(':')[0]}:{file.absolute()}"


def _recorded_m3c2(settings: M3C2Settings) -> Any:
    if not isinstance(settings.cores, Cloud):
        return settings.absolute().text
    return {item.name: _recorded(getattr(settings, item.name)) for item in fields(settings)}


def _restored(value: Any) -> Any:
    """Non-finite numbers are null in JSON and the defaults of their fields here."""
    if isinstance(value, Mapping) and "type" in value:
        given = {name: _restored(item) for name, item in value.items() if name != "type" and item is not None}
        return _TYPES[value["type"]](**given)
    if isinstance(value, Mapping):
        return {name: _restored(item) for name, item in value.items()}
    return tuple(_restored(item) for item in value) if isinstance(value, list) else value
