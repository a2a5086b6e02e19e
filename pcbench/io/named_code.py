"""Classes and functions that a user names: of an installed package, of a module, or of a Python file.

Only what is named is imported. Importing runs its code, so a name must come from the user, never from a file that
somebody else may have written.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import types
from collections.abc import Callable, Collection
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, NamedTuple

from pcbench.errors import InputError, did_you_mean
from pcbench.regular_files import regular_status

SUFFIX = ".py"


@dataclass(frozen=True)
class CodeKind:
    """A kind of object that a user may name.

    Attributes:
        group: group of the entry points of installed objects.
        noun: what one of them is called, such as `reconstructor`.
        form: what stands behind the colon, such as `CLASS`.
        suits: whether an object of a module is one, for hints.
    """

    group: str
    noun: str
    form: str
    suits: Callable[[Any], bool]

    def installed_names(self) -> tuple[str, ...]:
        """Return the names of the installed objects, sorted."""
        return tuple(sorted({point.name for point in entry_points(group=self.group)}))

    def find(self, spec: str) -> NamedObject:
        """Return the object that a spec names. No other one is imported.

        Args:
            spec: the name of an entry point, `module:name`, or `path/to/file.py:name`.

        Raises:
            InputError: there is none or there are several, or it cannot be imported.
        """
        module, colon, name = spec.rpartition(":")
        if (file := code_file(spec)) is not None:
            return NamedObject(str(file), self._attribute(spec, self._load(file), name))
        if colon:
            return NamedObject(module, self._attribute(spec, _import(spec, module), name))
        points = [point for point in entry_points(group=self.group) if point.name == spec]
        if not points:
            names = ", ".join(self.installed_names()) or "none"
            hint = did_you_mean(spec, self.installed_names())
            raise InputError(
                f"no {self.noun} {spec!r} is installed: there are {names}; or give FILE.py:{self.form}{hint}"
            )
        if len(points) > 1:
            packages = " and ".join(sorted(map(_origin, points)))
            raise InputError(f"two {self.noun}s are named {spec!r}, in {packages}: give MODULE:{self.form} instead")
        (point,) = points
        return NamedObject(_origin(point), self._attribute(spec, _import(spec, point.module), point.attr))

    def _load(self, path: Path) -> types.ModuleType:
        try:
            regular_status(path)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        except OSError:
            raise InputError(
                f"{path}: no such file; expected a Python file with a {self.noun}, as FILE.py:{self.form}"
            ) from None
        name = f"pcbench_plugin_{path.stem}"
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module  # dataclasses look up their module by name
        try:
            spec.loader.exec_module(module)
        except (Exception, SystemExit) as error:  # a plugin may raise anything while it is imported
            del sys.modules[name]
            raise InputError(f"{path}: cannot be imported: {error_summary(error)}") from error
        return module

    def _attribute(self, spec: str, module: types.ModuleType, name: str) -> Any:
        if not hasattr(module, name):
            suitable = sorted(other for other, value in vars(module).items() if self.suits(value))
            hint = f"; it has {', '.join(suitable)}" if suitable else ""
            raise InputError(f"{spec}: there is no {name!r} in the module{hint}")
        return getattr(module, name)


class NamedObject(NamedTuple):
    """An object that a user named, and its origin: a package with its version, a module, or a file."""

    origin: str
    value: Any


def code_file(spec: str) -> Path | None:
    """Return the file of a spec `FILE.py:name`; None for another one."""
    file, colon, _ = spec.rpartition(":")
    return Path(file) if colon and file.endswith(SUFFIX) else None


def error_summary(error: BaseException, files: Collection[str] = ()) -> str:
    """Return an error of a user's code on one line, with the file and the line where it was raised.

    Args:
        error: the error.
        files: files of which the innermost line is named; if none of them ran, the innermost line of all is named.
    """
    if isinstance(error, SyntaxError) and error.filename is not None:  # its text has the line, but only a file's name
        return _line_of(error, error.msg, (error.filename, error.lineno))
    places, traceback = [], error.__traceback__
    while traceback is not None:
        places.append((traceback.tb_frame.f_code.co_filename, traceback.tb_lineno))
        traceback = traceback.tb_next
    chosen = [place for place in places if place[0] in files] or places
    return _line_of(error, str(error), chosen[-1] if chosen else None)


def _line_of(error: BaseException, text: str, place: tuple[str, int | None] | None) -> str:
    location = f" ({place[0]}, line {place[1]})" if place is not None else ""
    return f"{type(error).__name__}: {' '.join(text.split())}{location}"


def _origin(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else point.module


def _import(spec: str, module: str) -> types.ModuleType:
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:
        raise InputError(f"{spec}: {module} cannot be imported: {error_summary(error)}") from error
