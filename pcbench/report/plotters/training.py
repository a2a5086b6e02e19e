"""A window that shows a model while it is trained."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from pcbench.errors import InputError
from pcbench.io import read_cloud
from pcbench.report.plot.maps import frame
from pcbench.report.plotters.stage import Stage, Window
from pcbench.scenes.previews import POINTS, Preview, read_preview

_RELOAD_INTERVAL_MS = 2000
_MAX_RELOADS = 2**31 - 1


class TrainingViewer:
    """A view of the points of a model that is being trained, with the state of the training as title.

    Args:
        folder: folder of the preview, see `pcbench.scenes.previews`.
        off_screen: whether to render without a window, for `plotter.screenshot`. A window shows new states by itself.

    Attributes:
        plotter: the plotter, which is not yet shown.
        preview: the state that is shown.

    Raises:
        InputError: the preview is damaged.
    """

    def __init__(self, folder: Path, *, off_screen: bool) -> None:
        self._folder, self.preview = folder, read_preview(folder)
        cloud = read_cloud(folder / POINTS, on_warning=lambda _: None)
        self._stage = Stage(frame(None, {"": cloud}), cloud.unit, Window(off_screen))
        self.plotter: Any = self._stage.plotter
        self._show(cloud, self.preview)
        if not off_screen:
            self.plotter.add_timer_event(_MAX_RELOADS, _RELOAD_INTERVAL_MS, lambda _: self.reload())

    def reload(self) -> None:
        """Show the newest state from the same viewpoint, if there is a new one."""
        with suppress(InputError, OSError):  # the folder was removed by the next run, which will write it again
            preview = read_preview(self._folder)
            if preview != self.preview:
                self._show(read_cloud(self._folder / POINTS, on_warning=lambda _: None), preview)
                self.plotter.render()

    def _show(self, cloud: Any, preview: Preview) -> None:
        self.preview = preview
        self._stage.add_points(cloud.points, "cloud", lit=True, scalars=cloud.colors, rgb=True, pickable=True)
        self._stage.write_title(preview.sentence)
