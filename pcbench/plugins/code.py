"""The digest of the code that decides what reconstructors do: sources and compiled modules, as they are on disk."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

from pcbench.io.files import digest

_SUFFIXES = frozenset({".py", ".so", ".pyd", ".dylib", ".cu", ".cuh", ".h", ".hpp"})
_OURS = ("pcbench", "reconstructors")
_INSTALLED = ("site-packages", "dist-packages")  # folders in which strangers' packages lie side by side

_plugins: dict[str, None] = {}  # modules of the plugins that run in this process


def running(module: str) -> None:
    """Count a plugin's code among that which decides the results of this process.

    Args:
        module: the name of the imported module with the plugin's class.
    """
    _plugins[module] = None


def code_digest() -> str:
    """SHA-256 of the code of pcbench, of its reconstructors, and of the plugins that run in this process.

    It is computed once per process for the same plugins: a process keeps the code that it has loaded.
    """
    return _code_digest(tuple(_plugins))


@cache
def _code_digest(plugins: tuple[str, ...]) -> str:
    return digest_files([*_files_of_packages(_OURS), *(file for module in plugins for file in plugin_files(module))])


def plugin_files(module: str) -> list[tuple[str, Path]]:
    """The code of a plugin by name: of its whole package, or, where its module is in none, of the module's folder and
    of what was imported from below it.

    Args:
        module: the name of the imported module with the plugin's class.
    """
    parents = module.split(".")
    packages = [".".join(parents[: end + 1]) for end in range(len(parents))]
    # A namespace package, which has no file, holds packages of many.
    package = next((name for name in packages if _is_package(name)), None)
    if package is not None:
        return list(_files_of_packages([package]))
    file = getattr(sys.modules.get(module), "__file__", None)
    return [] if file is None else _files_beside(Path(file))


def digest_files(files: Iterable[tuple[str, Path]]) -> str:
    """SHA-256 over the names and contents of files, in the order of their names."""
    whole = hashlib.sha256()
    for name, file in sorted(set(files)):
        whole.update(f"{name}\0{digest(file)}\0".encode(errors="surrogateescape"))
    return whole.hexdigest()


def _is_package(name: str) -> bool:
    module = sys.modules.get(name)
    return hasattr(module, "__path__") and getattr(module, "__file__", None) is not None


def _files_of_packages(packages: Iterable[str]) -> Iterator[tuple[str, Path]]:
    """All code below the folders of packages; an editable install has one of sources and one of compiled modules."""
    for package in packages:
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
            for file in Path(folder).rglob("*"):
                if file.suffix in _SUFFIXES and file.is_file():
                    yield f"{package}/{file.relative_to(folder).as_posix()}", file


def _files_beside(plugin: Path) -> list[tuple[str, Path]]:
    """A plugin's file, the code in its folder, and what was imported from the folders below, but for what pip installed
    there.
    """
    folder = plugin.absolute().parent
    files = {plugin.absolute()}
    if folder.name not in _INSTALLED:
        files |= {file for file in folder.iterdir() if file.suffix in _SUFFIXES and file.is_file()}
        imported = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
        below = {Path(file) for file in imported if file and Path(file).is_relative_to(folder)}
        files |= {file for file in below if not set(file.relative_to(folder).parts) & set(_INSTALLED)}
    return [(file.relative_to(folder).as_posix(), file) for file in files]
