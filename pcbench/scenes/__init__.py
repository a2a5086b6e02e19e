"""Scenes: photographs with their cameras, read from folders or created synthetically."""

from pcbench.scenes.from_folder import read_scene
from pcbench.scenes.scene import Scene
from pcbench.scenes.write import write_cameras

__all__ = ["Scene", "read_scene", "write_cameras"]
