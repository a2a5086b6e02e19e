"""Compiled PatchMatch search for depth maps."""

from reconstructors.mvs.native import _patchmatch

__all__ = ["_patchmatch"]
