"""Import of optional libraries: a missing one and one that cannot be loaded raise the same one-line error."""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from typing import Any, NamedTuple

from pcbench.errors import MissingExtra


class _Library(NamedTuple):
    name: str  # on the package index
    extra: str  # the extra of pcbench that installs it; empty without one


LIBRARIES = {
    "PIL": _Library("pillow", "sfm"),
    "cuda": _Library("cuda-core", "cuda"),
    "cv2": _Library("opencv-python-headless", ""),
    "distributed": _Library("distributed", "cluster"),
    "fricp_cpp": _Library("fricp-cpp", ""),
    "flip_evaluator": _Library("flip-evaluator", ""),
    "jinja2": _Library("jinja2", ""),  # of pages; a dependency of pcbench, so that only a broken installation lacks it
    "kiss_matcher": _Library("kiss-matcher", "global"),
    "lazrs": _Library("lazrs", "las"),
    "matplotlib": _Library("matplotlib", "plot"),
    "open3d": _Library("open3d", "open3d"),
    "pandas": _Library("pandas", ""),
    "point_cloud_utils": _Library("point-cloud-utils", ""),
    "pycolmap": _Library("pycolmap", "sfm"),
    "pye57": _Library("pye57", "e57"),
    "pymeshlab": _Library("pymeshlab", "meshlab"),
    "pyproj": _Library("pyproj", "las"),
    "pyvista": _Library("pyvista", "plot"),
    "small_gicp": _Library("small_gicp", ""),
    "tifffile": _Library("tifffile", ""),  # of grids of heights in GeoTIFF
    "torch": _Library("torch", "splat"),
    "trimesh": _Library("trimesh", "mesh"),
    "zstandard": _Library("zstandard", ""),  # of .spz files of version 4
}

_LOADER_ERROR = re.compile(r"(?:^|[\s/])(lib[^\s/:]+\.so(?:\.\d+)*): (?:cannot open shared|file too short|invalid ELF)")
# Debian packages whose names do not follow from the file name of the library.
_DEBIAN_PACKAGES = {
    "libGLU.so.1": "libglu1-mesa",
    "libOSMesa.so.6": "libosmesa6",
    "libOSMesa.so.8": "libosmesa6",
    "libglib-2.0.so.0": "libglib2.0-0",
    "libz.so.1": "zlib1g",
}


def require(module: str, extra: str | None = None) -> Any:
    """Import an optional library, or a module of one.

    Args:
        module: name of the module in Python, such as `matplotlib.figure`.
        extra: extra of pcbench to name in the error; by default the smallest that installs the library.

    Raises:
        MissingExtra: the library is not installed or cannot be loaded.
    """
    try:
        return import_module(module)
    except Exception as error:  # importing a library may raise anything
        raise missing_extra(module, error, extra) from error


def import_problem(*libraries: str, extra: str | None = None) -> str | None:
    """Return one line about the first of these libraries that cannot be imported; None if all can.

    The libraries are loaded, because an installed one may lack a system library.

    Args:
        *libraries: names of the modules in Python.
        extra: extra of pcbench to name in the line; see `require`.
    """
    for library in libraries:
        try:
            require(library, extra)
        except MissingExtra as error:
            return str(error)
    return None


def installed_versions(names: Iterable[str]) -> dict[str, str]:
    """Return the versions of these distributions, without those that are not installed."""
    from importlib.metadata import PackageNotFoundError, version

    versions = {}
    for name in names:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def package_version() -> str:
    """Return the version of pcbench; `0+unknown` for a source tree that was never installed."""
    return installed_versions(("pcbench",)).get("pcbench", "0+unknown")


def debian_package(library: str) -> str:
    """Return the Debian package of a shared library such as `libusb-1.0.so.0`.

    The package name is the library's name and version, with a hyphen between two digits (Debian Policy, section 8.1).
    """
    if library in _DEBIAN_PACKAGES:
        return _DEBIAN_PACKAGES[library]
    name, _, version = library.lower().partition(".so")
    version = version.lstrip(".").partition(".")[0]
    return f"{name}-{version}" if name[-1].isdigit() and version else f"{name}{version}"


def missing_extra(module: str, error: Exception, extra: str | None = None) -> MissingExtra:
    """Return the error for a module whose import raised `error`; `extra` as in `require`."""
    root = module.partition(".")[0]
    name, default = LIBRARIES.get(root, _Library(root, ""))
    extra = extra or default
    install = f"pip install 'pcbench[{extra}]'" if extra else f"pip install {name}"
    if isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}."):
        return MissingExtra(name, extra, remedy=install)
    text = " ".join(str(error).split())[:300]
    kind = "" if isinstance(error, (ImportError, OSError)) and text else f"{type(error).__name__}: "
    reason = f"it is installed but cannot be loaded: {kind}{text}"
    if library := _LOADER_ERROR.search(text):
        return MissingExtra(name, extra, reason, f"on Debian, apt-get install {debian_package(library[1])}")
    return MissingExtra(name, extra, reason, f"reinstall it ({install})")
