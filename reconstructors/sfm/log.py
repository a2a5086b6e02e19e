"""The log of COLMAP: errors and warnings on the standard error, and no files."""

from __future__ import annotations


def log_without_files() -> None:
    """Let COLMAP log warnings and errors on the standard error alone; it also leaves files in the temporary folder."""
    from pycolmap import logging

    logging.minloglevel = logging.Level.WARNING.value
    for level in (logging.Level.INFO, logging.Level.WARNING, logging.Level.ERROR, logging.Level.FATAL):
        logging.set_log_destination(level, "")  # no file
