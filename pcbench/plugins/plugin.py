"""Reconstructors: their interface, how they are found, and how their settings are parsed.

A reconstructor is a frozen dataclass with one method, `reconstruct`. Its fields are its settings, and its docstring is
its help. A class method `missing() -> str | None` may return the reason why it cannot run on this machine.
"""

from __future__ import annotations

import inspect
import math
import re
import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, Union, get_args, get_origin, get_type_hints, runtime_checkable

from pcbench.errors import InputError, did_you_mean
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.geodesy import Gps
from pcbench.io.named_code import CodeKind, error_summary
from pcbench.plugins.code import plugin_files
from pcbench.registration import SurveyResiduals
from pcbench.scenes import Scene

ENTRY_POINT_GROUP = "pcbench.reconstructors"
_INT32_RANGE = range(-(2**31), 2**31)  # valid integer settings, because C++ libraries use 32 bits

Gauge = Literal["arbitrary", "metric", "georeferenced"]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Result of a reconstructor.

    Args:
        cloud: the point cloud.
        gauge: meaning of the coordinates: "arbitrary" (arbitrary frame and scale), "metric" (true scale, arbitrary
            frame) or "georeferenced" (the scene's frame, from its cameras, control points or GPS).
        cameras: the cameras that were solved or used, by image name, in the cloud's frame; None for no cameras, stored
            as an empty mapping.
        notes: remarks for the user, such as images that were left out, one line each. A note that starts with
            "warning: " means that the result may be wrong, and is displayed as a warning.
        residuals: residuals at surveyed points.
        origin: geographic position of (0, 0, 0) if the frame is east-north-up in metres, such as that of GPS positions
            (`Scene.gps_origin`) or of cameras with a known origin (`Scene.origin`); None if it is another or unknown.

    Raises:
        InputError: a value has the wrong type, or the gauge is unknown.
    """

    cloud: Cloud
    gauge: Gauge
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    notes: Sequence[str] = ()
    residuals: SurveyResiduals = field(default_factory=SurveyResiduals)
    origin: Gps | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.cloud, Cloud):
            raise InputError(f"expected a pcbench.Cloud as the cloud, got {type(self.cloud).__name__}")
        if self.gauge not in get_args(Gauge):
            raise InputError(f"expected a gauge of {', '.join(get_args(Gauge))}; got {self.gauge!r}")
        cameras: Any = {} if self.cameras is None else self.cameras
        object.__setattr__(self, "cameras", cameras)
        if not isinstance(cameras, Mapping) or not all(isinstance(c, Camera) for c in cameras.values()):
            raise InputError("expected cameras as a mapping from image names to pcbench.geometry.cameras.Camera")
        if self.origin is not None:
            object.__setattr__(self, "origin", _checked_origin(self.origin))


def _checked_origin(origin: Any) -> Gps:
    try:
        checked = Gps(*map(float, origin))
    except (TypeError, ValueError):
        raise InputError(f"expected the origin as latitude, longitude and altitude, got {origin!r}") from None
    if not (all(map(math.isfinite, checked)) and abs(checked.latitude_deg) <= 90):
        raise InputError(f"expected a latitude from -90 to 90 degrees and finite numbers as the origin, got {origin!r}")
    return checked


@runtime_checkable
class Reconstructor(Protocol):
    """Interface of a reconstructor."""

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        """Compute a cloud from a scene.

        Args:
            scene: the images, with cameras and masks if there are any.
            workspace: a folder for the reconstructor's files, kept for the next run (see `pcbench.plugins.stages`).
        """
        ...


@dataclass(frozen=True)
class Setting:
    """A reconstructor's setting: its name, its type as written, and its default as text (None if it is required)."""

    name: str
    type: str
    default: str | None


@dataclass(frozen=True)
class Plugin:
    """A reconstructor's class and its origin: a package with its version, or a file."""

    name: str
    origin: str
    cls: type[Any]

    @property
    def help(self) -> str:
        """The first paragraph of the class's docstring, on one line."""
        return " ".join(self.docstring.split("\n\n")[0].split())

    @property
    def docstring(self) -> str:
        """The class's docstring; empty without one."""
        # Python generates the signature as the docstring of a dataclass without one.
        text = inspect.getdoc(self.cls) or ""
        return "" if text.startswith(f"{self.cls.__name__}(") else text

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The settings of the reconstructor, in the order of its fields."""
        hints = get_type_hints(self.cls)
        return tuple(Setting(f.name, _type_name(hints[f.name]), _default_text(f)) for f in fields(self.cls) if f.init)

    @property
    def missing(self) -> str | None:
        """Why the reconstructor cannot run here, as it reports; None if it can."""
        check = getattr(self.cls, "missing", None)
        try:
            return check() if callable(check) else None
        except Exception as error:  # it may raise anything
            return f"missing() failed: {self.error_summary(error)}"

    def error_summary(self, error: Exception) -> str:
        """Return an error of the reconstructor on one line, with the innermost line of the reconstructor."""
        return error_summary(error, {str(file) for _, file in plugin_files(self.cls.__module__)})

    def configure(self, settings: Mapping[str, str]) -> Reconstructor:
        """Create a reconstructor from settings as text, converted to the types of its fields.

        Raises:
            InputError: a setting is unknown, missing, of the wrong type, or rejected by the reconstructor.
        """
        settable = {f.name: f for f in fields(self.cls) if f.init}
        if unknown := [name for name in settings if name not in settable]:
            names = ", ".join(settable) or "none"
            hint = did_you_mean(unknown[0], settable)
            raise InputError(f"{self.name} has no setting {unknown[0]!r}: there are {names}{hint}")
        if required := [n for n, f in settable.items() if _default_text(f) is None and n not in settings]:
            raise InputError(f"{self.name} needs the setting {required[0]!r}: give --set {required[0]}=VALUE")
        hints = get_type_hints(self.cls)
        values = {name: _convert(name, text, hints[name]) for name, text in settings.items()}
        try:
            reconstructor: Reconstructor = self.cls(**values)
        except InputError:  # is a ValueError too, but has a complete message
            raise
        except (TypeError, ValueError) as error:
            raise InputError(f"{self.name}: {error}") from error
        except Exception as error:  # its check of the settings may raise anything
            raise InputError(f"{self.name}: {self.error_summary(error)}") from error
        return reconstructor


def find_plugin(spec: str) -> Plugin:
    """Find the reconstructor that a spec names. No other reconstructor is imported.

    Args:
        spec: the name of an installed reconstructor (an entry point of the group `pcbench.reconstructors`),
            `module:Class`, or `path/to/file.py:Class`.

    Raises:
        InputError: no reconstructor or several have that name, it cannot be imported, or it is not a reconstructor.
    """
    origin, cls = _RECONSTRUCTORS.find(spec)
    return _check_plugin(spec, origin, cls)


def installed_reconstructors() -> tuple[str, ...]:
    """Return the names of the installed reconstructors, sorted."""
    return _RECONSTRUCTORS.installed_names()


def _is_reconstructor(value: Any) -> bool:
    return inspect.isclass(value) and callable(getattr(value, "reconstruct", None))


_RECONSTRUCTORS = CodeKind(ENTRY_POINT_GROUP, "reconstructor", "CLASS", _is_reconstructor)


def _check_plugin(spec: str, origin: str, cls: Any) -> Plugin:
    method: Any = getattr(cls, "reconstruct", None)
    if not (inspect.isclass(cls) and is_dataclass(cls) and _is_reconstructor(cls)):
        raise InputError(
            f"{spec}: expected a dataclass with a method reconstruct(self, scene, workspace), got {_describe(cls)}"
        )
    try:
        inspect.signature(method).bind("self", "scene", "workspace")
    except TypeError:
        form = f"reconstruct{inspect.signature(method)}"
        raise InputError(f"{spec}: expected a method reconstruct(self, scene, workspace), got {form}") from None
    try:
        get_type_hints(cls)
    except NameError as error:
        raise InputError(f"{spec}: the type of a setting is unknown: {error}") from error
    return Plugin(spec, origin, cls)


def _describe(value: Any) -> str:
    return f"the class {value.__name__}" if inspect.isclass(value) else f"a {type(value).__name__}"


def _default_text(f: Field[Any]) -> str | None:
    if f.default is not MISSING:
        return str(f.default)
    return str(f.default_factory()) if f.default_factory is not MISSING else None


def _type_name(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return "|".join(str(value) for value in get_args(kind))
    if get_origin(kind) in (Union, types.UnionType):
        return "|".join("none" if part is type(None) else _type_name(part) for part in get_args(kind))
    return str(getattr(kind, "__name__", kind))


def _convert(name: str, text: str, kind: Any) -> Any:
    """Convert text to the type of a field: bool, int, float, str, Path, choices, or X | None."""
    if get_origin(kind) in (Union, types.UnionType):
        parts = get_args(kind)
        if type(None) in parts and text.lower() == "none":
            return None
        for part in parts:
            if part is not type(None):
                try:
                    return _convert(name, text, part)
                except InputError:
                    continue
    elif get_origin(kind) is Literal:
        for value in get_args(kind):
            if str(value) == text:
                return value
    elif kind is bool:
        if text.lower() in ("true", "yes", "on", "1", "false", "no", "off", "0"):
            return text.lower() in ("true", "yes", "on", "1")
    elif kind is int:
        if (number := _parse_integer(text)) is not None:
            if number not in _INT32_RANGE:
                raise InputError(f"expected {name} from {_INT32_RANGE[0]} to {_INT32_RANGE[-1]}, got {text[:40]!r}")
            return number
    elif kind in (float, str, Path):
        try:
            return kind(text)
        except ValueError:
            pass
    else:
        raise InputError(f"the setting {name!r} is of type {_type_name(kind)}, which --set does not support")
    hint = did_you_mean(text[:60], map(str, get_args(kind))) if get_origin(kind) is Literal else ""
    raise InputError(f"expected {name} as {_type_name(kind)}, got {text[:60]!r}{hint}")


def _parse_integer(text: str) -> int | None:
    """Parse an integer of any length; None if the text is not one."""
    if re.fullmatch(r"\s*[+-]?\d[\d_]{20,}\s*", text):
        return _INT32_RANGE[-1] + 1  # Python converts at most 4,300 digits
    try:
        return int(text)
    except ValueError:
        return None
