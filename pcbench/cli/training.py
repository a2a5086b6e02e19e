"""The page of a training that `pcbench reconstruct` runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pcbench.errors import PcbenchError

PAGE = "training.html"  # in the workspace


class TrainingPage:
    """Page in a workspace that is written again whenever the reconstructor has written a new preview.

    Args:
        workspace: the workspace.
        announce: called once, with a line that tells how to watch the training.
    """

    def __init__(self, workspace: Path, announce: Callable[[str], None]) -> None:
        self._workspace, self._announce = workspace, announce
        self._first = self._shown = self._time_ns()

    def update(self, *, running: bool = True) -> None:
        """Write the page if there is a new preview, or for the last time if the training has ended.

        The page is a convenience: if it cannot be written, the training goes on without it.
        """
        from pcbench.report.html.training import training_page
        from pcbench.scenes.previews import find_preview, read_preview
        from pcbench.scratch import atomic_write

        folder, time_ns = find_preview(self._workspace), self._time_ns()
        if folder is None or time_ns == self._first or (running and time_ns == self._shown):
            return
        page, command = self._workspace / PAGE, f"pcbench view {self._workspace}"
        try:
            text = training_page(read_preview(folder), folder, command, running=running)
            with atomic_write(page) as file:
                file.write(text.encode(errors="backslashreplace"))
        except (PcbenchError, OSError):
            return
        if running and self._shown == self._first:
            self._announce(f"watch the training: {command}, or open {page} in a browser")
        self._shown = time_ns

    def _time_ns(self) -> int | None:
        """Return when the preview was written; None without one."""
        from pcbench.scenes.previews import DOCUMENT, find_preview

        folder = find_preview(self._workspace)
        try:
            return None if folder is None else (folder / DOCUMENT).stat().st_mtime_ns
        except OSError:
            return None
