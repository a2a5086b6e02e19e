"""Digest of the code that determines the results of reconstructors: source files and compiled modules."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

from pcbench.io.contents import digest

_SUFFIXES = frozenset({".py", ".so", ".pyd", ".dylib", ".cu", ".cuh", ".h", ".hpp"})
_OWN_PACKAGES = ("pcbench", "reconstructors")
_INSTALL_FOLDERS = ("site-packages", "dist-packages")  # they contain unrelated packages side by side

_plugin_modules: dict[str, None] = {}  # modules of the plugins that run in this process


def register_plugin_code(module: str) -> None:
    """Include a plugin's code in the digest of this process.

    Args:
        module: the name of the imported module with the plugin's class.
    """
    _plugin_modules[module] = None


def code_digest() -> str:
    """SHA-256 of the code of pcbench, of its reconstructors, and of the plugins that run in this process.

    It is computed once per process and set of plugins, because a process keeps the code that it has loaded.
    """
    return _code_digest(tuple(_plugin_modules))


@cache
def _code_digest(plugins: tuple[str, ...]) -> str:
    return digest_files(
        [*_files_of_packages(_OWN_PACKAGES), *(file for module in plugins for file in plugin_files(module))]
    )


def plugin_files(module: str) -> list[tuple[str, Path]]:
    """Return the code of a plugin as pairs of name and file.

    This is the plugin's package. For a module without a package it is the module's folder and the modules imported from
    its subfolders.

    Args:
        module: the name of the imported module with the plugin's class.
    """
    parents = module.split(".")
    packages = [".".join(parents[: end + 1]) for end in range(len(parents))]
    # A namespace package has no file, and may contain packages of several distributions.
    package = next((name for name in packages if _is_package(name)), None)
    if package is not None:
        return list(_files_of_packages([package]))
    file = getattr(sys.modules.get(module), "__file__", None)
    return [] if file is None else _files_beside(Path(file))


def digest_files(files: Iterable[tuple[str, Path]]) -> str:
    """Return the SHA-256 over the names and contents of files, in the order of their names."""
    total = hashlib.sha256()
    for name, file in sorted(set(files)):
        total.update(f"{name}\0{digest(file)}\0".encode(errors="surrogateescape"))
    return total.hexdigest()


def _is_package(name: str) -> bool:
    module = sys.modules.get(name)
    return hasattr(module, "__path__") and getattr(module, "__file__", None) is not None


def _files_of_packages(packages: Iterable[str]) -> Iterator[tuple[str, Path]]:
    """Yield all code in the folders of packages; an editable install has two, for sources and for compiled modules."""
    for package in packages:
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
            for file in Path(folder).rglob("*"):
                if file.suffix in _SUFFIXES and file.is_file():
                    yield f"{package}/{file.relative_to(folder).as_posix()}", file


def _files_beside(plugin: Path) -> list[tuple[str, Path]]:
    """Return a plugin's file, the code in its folder, and imported modules in subfolders.

    Packages that pip installed in a subfolder are left out.
    """
    folder = plugin.absolute().parent
    files = {plugin.absolute()}
    if folder.name not in _INSTALL_FOLDERS:
        files |= {file for file in folder.iterdir() if file.suffix in _SUFFIXES and file.is_file()}
        imported = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
        below = {Path(file) for file in imported if file and Path(file).is_relative_to(folder)}
        files |= {file for file in below if not set(file.relative_to(folder).parts) & set(_INSTALL_FOLDERS)}
    return [(file.relative_to(folder).as_posix(), file) for file in files]
