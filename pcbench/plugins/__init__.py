"""Reconstructors as plugins: what one is, how it is found, and how it is run."""

from pcbench.plugins.plugin import (
    GROUP,
    Gauge,
    Plugin,
    Reconstruction,
    Reconstructor,
    Setting,
    find_plugin,
    installed,
)

__all__ = ["GROUP", "Gauge", "Plugin", "Reconstruction", "Reconstructor", "Setting", "find_plugin", "installed"]
