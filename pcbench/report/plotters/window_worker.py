"""Probe process: `window_worker window|picture` opens and renders a hidden window, or renders off screen.

VTK ends the process where OpenGL is broken, so this is tried before the process that matters does it.
"""

from __future__ import annotations

import sys

from pcbench.opengl import select_opengl

_WITHOUT_WINDOWS = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")  # what VTK uses if it finds no display


def main() -> int:
    """Render one empty picture; the exit code is 0 if that works."""
    select_opengl()
    from vtkmodules import vtkRenderingOpenGL2  # noqa: F401  # OpenGL classes for the window
    from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow

    window = vtkRenderWindow()
    if sys.argv[1] == "window" and window.GetClassName() in _WITHOUT_WINDOWS:
        print("the display cannot be opened", file=sys.stderr)
        return 1
    window.SetShowWindow(False)
    window.SetOffScreenRendering(sys.argv[1] == "picture")
    window.SetSize(16, 16)
    window.AddRenderer(vtkRenderer())
    window.Render()
    if not window.SupportsOpenGL():
        print("the driver has no OpenGL 3.2", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
