"""Scenes: photographs and what is known about their cameras, read from folders or made synthetically."""

from pcbench.scenes.read import read_scene
from pcbench.scenes.scene import Scene
from pcbench.scenes.write import write_cameras

__all__ = ["Scene", "read_scene", "write_cameras"]
