"""Reconstructors: what they are, where they are looked up, and how their settings are read.

A reconstructor is a frozen dataclass with one method, `reconstruct`. Its fields are its settings, its docstring is its
help. It may have a class method `missing() -> str | None` that says what keeps it from running on this machine.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal, Protocol, Union, get_args, get_origin, get_type_hints, runtime_checkable

from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.registration import SurveyResiduals
from pcbench.regular_files import regular_status
from pcbench.scenes import Scene

GROUP = "pcbench.reconstructors"
_INTEGERS = range(-(2**31), 2**31)  # that settings may be: those of C++ libraries have 32 bits

Gauge = Literal["arbitrary", "metric", "georeferenced"]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What a reconstructor returns.

    Args:
        cloud: its points.
        gauge: what its coordinates mean: "arbitrary" (frame and scale of its own), "metric" (true scale, frame of its
            own) or "georeferenced" (the world of the scene: that of its cameras, its control points or its GPS).
        cameras: by image name, in the cloud's frame, as far as it has found or used them; None, kept as an empty
            mapping, for none.
        notes: lines on what a reader should know, such as images that were left out. One that begins with "warning: "
            says that the result may be wrong, and is shown as a warning.

    Raises:
        InputError: one of them is something else.
    """

    cloud: Cloud
    gauge: Gauge
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    notes: Sequence[str] = ()
    residuals: SurveyResiduals = field(default_factory=SurveyResiduals)

    def __post_init__(self) -> None:
        if not isinstance(self.cloud, Cloud):
            raise InputError(f"expected a pcbench.Cloud as the cloud, got {type(self.cloud).__name__}")
        if self.gauge not in get_args(Gauge):
            raise InputError(f"expected a gauge of {', '.join(get_args(Gauge))}; got {self.gauge!r}")
        cameras: Any = {} if self.cameras is None else self.cameras
        object.__setattr__(self, "cameras", cameras)
        if not isinstance(cameras, Mapping) or not all(isinstance(c, Camera) for c in cameras.values()):
            raise InputError("expected cameras as a mapping from image names to pcbench.geometry.cameras.Camera")


@runtime_checkable
class Reconstructor(Protocol):
    """Makes a cloud of a scene. The workspace is a folder of its own, which keeps what it left there for the next run:
    see `pcbench.plugins.stages`.
    """

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction: ...


@dataclass(frozen=True)
class Setting:
    """A field of a reconstructor: its name, its type as written, and its default as text (None: it must be given)."""

    name: str
    type: str
    default: str | None


@dataclass(frozen=True)
class Plugin:
    """A reconstructor's class, and where it came from: a package with its version, or a file."""

    name: str
    origin: str
    cls: type[Any]

    @property
    def help(self) -> str:
        """The first paragraph of its docstring, on one line."""
        return " ".join(self.docstring.split("\n\n")[0].split())

    @property
    def docstring(self) -> str:
        # A dataclass without a docstring gets its signature for one.
        text = inspect.getdoc(self.cls) or ""
        return "" if text.startswith(f"{self.cls.__name__}(") else text

    @property
    def settings(self) -> tuple[Setting, ...]:
        hints = get_type_hints(self.cls)
        return tuple(Setting(f.name, _type_name(hints[f.name]), _default(f)) for f in fields(self.cls) if f.init)

    @property
    def missing(self) -> str | None:
        """What keeps it from running here, by its own account."""
        check = getattr(self.cls, "missing", None)
        return check() if callable(check) else None

    def configure(self, settings: Mapping[str, str]) -> Reconstructor:
        """A reconstructor with the given settings, which are converted to the types of its fields.

        Raises:
            InputError: a setting does not exist, is not of its type, is refused by the reconstructor, or is missing.
        """
        known = {f.name: f for f in fields(self.cls) if f.init}
        if unknown := [name for name in settings if name not in known]:
            there = ", ".join(known) or "none"
            raise InputError(f"{self.name} has no setting {unknown[0]!r}: there are {there}")
        if lacking := [n for n, f in known.items() if _default(f) is None and n not in settings]:
            raise InputError(f"{self.name} needs the setting {lacking[0]!r}: give --set {lacking[0]}=VALUE")
        hints = get_type_hints(self.cls)
        values = {name: _convert(name, text, hints[name]) for name, text in settings.items()}
        try:
            reconstructor: Reconstructor = self.cls(**values)
        except InputError:  # a ValueError too, but it says all already
            raise
        except (TypeError, ValueError) as error:
            raise InputError(f"{self.name}: {error}") from error
        return reconstructor


def find_plugin(spec: str) -> Plugin:
    """The reconstructor that a spec names. Only this one is loaded.

    Args:
        spec: the name of an installed one (an entry point of the group `pcbench.reconstructors`), `module:Class`, or
            `path/to/file.py:Class`.

    Raises:
        InputError: there is none, or two of that name; it cannot be imported; or it is no reconstructor.
    """
    left, colon, name = spec.rpartition(":")
    if colon and left.endswith(".py"):
        return _checked(spec, str(Path(left)), _attribute(spec, _load_file(Path(left)), name))
    if colon:
        return _checked(spec, left, _attribute(spec, _import(spec, left), name))
    found = [point for point in entry_points(group=GROUP) if point.name == spec]
    if not found:
        names = ", ".join(sorted({point.name for point in entry_points(group=GROUP)})) or "none"
        raise InputError(f"no reconstructor {spec!r} is installed: there are {names}; or give FILE.py:CLASS")
    if len(found) > 1:
        packages = " and ".join(sorted(_origin(point) for point in found))
        raise InputError(f"two reconstructors are named {spec!r}, of {packages}: give MODULE:CLASS instead")
    return _checked(spec, _origin(found[0]), _attribute(spec, _import(spec, found[0].module), found[0].attr))


def installed() -> tuple[str, ...]:
    """The names of the installed reconstructors, sorted."""
    return tuple(sorted({point.name for point in entry_points(group=GROUP)}))


def _origin(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else point.module


def _import(spec: str, module: str) -> types.ModuleType:
    try:
        return importlib.import_module(module)
    except Exception as error:  # whatever a stranger's module raises
        raise InputError(f"{spec}: {module} cannot be imported: {_one_line(error)}") from error


def _load_file(path: Path) -> types.ModuleType:
    try:
        regular_status(path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except OSError:
        raise InputError(
            f"{path}: no such file: expected a Python file with a reconstructor, as FILE.py:CLASS"
        ) from None
    name = f"pcbench_plugin_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise InputError(f"{path}: cannot be imported: {_one_line(error)}") from error
    return module


def _one_line(error: Exception) -> str:
    at = error.__traceback__
    while at is not None and at.tb_next is not None:
        at = at.tb_next
    place = f" ({at.tb_frame.f_code.co_filename}, line {at.tb_lineno})" if at is not None else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())}{place}"


def _attribute(spec: str, module: types.ModuleType, name: str) -> Any:
    if not hasattr(module, name):
        classes = [n for n, v in vars(module).items() if inspect.isclass(v) and callable(getattr(v, "reconstruct", 0))]
        there = f": it has {', '.join(sorted(classes))}" if classes else ""
        raise InputError(f"{spec}: there is no {name!r} in it{there}")
    return getattr(module, name)


def _checked(spec: str, origin: str, cls: Any) -> Plugin:
    if not (inspect.isclass(cls) and is_dataclass(cls) and callable(getattr(cls, "reconstruct", None))):
        raise InputError(
            f"{spec}: expected a dataclass with a method reconstruct(self, scene, workspace), got {_describe(cls)}"
        )
    try:
        get_type_hints(cls)
    except NameError as error:
        raise InputError(f"{spec}: the type of a setting is not known: {error}") from error
    return Plugin(spec, origin, cls)


def _describe(value: Any) -> str:
    return f"the class {value.__name__}" if inspect.isclass(value) else f"a {type(value).__name__}"


def _default(f: Field[Any]) -> str | None:
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
    """The value that `text` means for a field of type `kind`: bool, int, float, str, Path, choices, or X | None."""
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
        if (number := _whole(text)) is not None:
            if number not in _INTEGERS:
                raise InputError(f"expected {name} from {_INTEGERS[0]} to {_INTEGERS[-1]}, got {text[:40]!r}")
            return number
    elif kind in (float, str, Path):
        try:
            return kind(text)
        except ValueError:
            pass
    else:
        raise InputError(f"the setting {name!r} is a {_type_name(kind)}, which --set cannot give")
    raise InputError(f"expected {name} as {_type_name(kind)}, got {text[:60]!r}")


def _whole(text: str) -> int | None:
    """The whole number that a text is, however long; None where it is none."""
    if re.fullmatch(r"\s*[+-]?\d[\d_]{20,}\s*", text):
        return _INTEGERS[-1] + 1  # of any length: Python converts no more than 4,300 digits
    try:
        return int(text)
    except ValueError:
        return None
