"""Reconstructors as plugins: how they are defined, found and run."""

from pcbench.plugins.plugin import (
    ENTRY_POINT_GROUP,
    Gauge,
    Plugin,
    Reconstruction,
    Reconstructor,
    Setting,
    find_plugin,
    installed_reconstructors,
)

__all__ = [
    "ENTRY_POINT_GROUP",
    "Gauge",
    "Plugin",
    "Reconstruction",
    "Reconstructor",
    "Setting",
    "find_plugin",
    "installed_reconstructors",
]
