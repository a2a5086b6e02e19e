"""Digest of the code of pcbench that the runs of a study depend on."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import PurePath

from pcbench.plugins.code import digest_files, plugin_files

# Folders of pcbench that no result of a measurement depends on.
_INDEPENDENT_FOLDERS = ("cli", "plugins", "report", "studies")


def measuring_code_digest(study: str, modules: Collection[str]) -> str:
    """Return the SHA-256 of the code that the results of a study's runs depend on.

    Args:
        study: name of the study's folder.
        modules: names of its modules and folders that they depend on.
    """
    files = [(name, path) for name, path in plugin_files("pcbench") if _matters(name, study, modules)]
    return digest_files(files)


def _matters(name: str, study: str, modules: Collection[str]) -> bool:
    parts = PurePath(name).with_suffix("").parts
    inside = parts[1:] if parts and parts[0] == "pcbench" else parts
    if inside[:2] == ("studies", study):
        return inside[2] in modules
    return len(inside) < 2 or inside[0] not in _INDEPENDENT_FOLDERS
