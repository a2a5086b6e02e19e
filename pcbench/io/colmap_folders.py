"""Find COLMAP models in folders. COLMAP's mapper writes one model for each connected group of images: 0, 1, ..."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from pcbench.errors import InputError
from pcbench.io.colmap_text import count_items
from pcbench.io.files import Warn
from pcbench.regular_files import has_entry, open_regular, read_bytes

Content = Literal["points", "images"]

POINT_FILES = ("points3D.bin", "points3D.txt")  # binary first: it stores the exact values
CAMERA_FILES = ("cameras.bin", "cameras.txt", "images.bin", "images.txt")
MAX_MODEL_BYTES = 64 << 30  # of one file; images and points store all keypoints

# Where COLMAP, nerfstudio (colmap/sparse) and hloc (models) store a model or numbered models in a folder.
_PLACES = (".", "sparse", "colmap/sparse", "colmap", "models")
_ITEM_BYTES = {"points": 51, "images": 73}  # at least, in binary files
_MAX_NAMED = 6  # models that a warning names


class _CountedModel(NamedTuple):
    folder: Path
    images: int  # 0 if the file is missing or damaged
    points: int  # likewise

    @property
    def size(self) -> tuple[int, int]:
        """Numbers by which models are ranked."""
        return self.images, self.points

    @property
    def counts(self) -> str:
        """Numbers of images and points in words, without those that are 0."""
        numbers = {"images": self.images, "points": self.points}
        return ", ".join(f"{number:,} {noun}" for noun, number in numbers.items() if number) or "damaged"


def is_colmap_model(folder: Path) -> bool:
    """Return whether a folder contains the cameras and images files of a model, text or binary."""
    return any(has_entry(folder / f"cameras{e}") and has_entry(folder / f"images{e}") for e in (".bin", ".txt"))


def points_file(folder: Path) -> Path | None:
    """Return the file with the points of the model in a folder; None if there is none."""
    return next((folder / name for name in POINT_FILES if has_entry(folder / name)), None)


def find_model(path: Path, content: Content, warn: Warn | None = None) -> Path | None:
    """Return the folder of the COLMAP model in a folder, or of the largest of several models; None if there is none.

    Models are searched in the folder, in sparse/, colmap/sparse/, colmap/ and models/, and in the numbered subfolders
    of these. The largest has the most images and, among these, the most points, whichever are read: points and cameras
    of two models would have different coordinates. The first of several equally large models is returned.

    Args:
        path: folder. A folder that holds one model itself, such as sparse/1, is returned unless it holds others too.
        content: whether models need points, or images with cameras.
        warn: callback, called with one line, without the path, that names all of several models.

    Raises:
        OSError: a folder cannot be listed.
    """
    folders = list(_model_folders(path, content))
    if len(folders) < 2:
        return folders[0] if folders else None
    models = [_CountedModel(folder, _count(folder, "images"), _count(folder, "points")) for folder in folders]
    largest = max(models, key=lambda model: model.size)
    if warn is not None:
        warn(_describe(path, models, content))
    return largest.folder


def _model_folders(path: Path, content: Content) -> Iterator[Path]:
    for place in _PLACES:
        folder = path / place
        if not folder.is_dir():
            continue
        numbered = [entry for entry in folder.iterdir() if entry.name.isdecimal() and entry.name.isascii()]
        for model in (folder, *sorted(numbered, key=lambda entry: (int(entry.name), entry.name))):
            if is_colmap_model(model) if content == "images" else points_file(model) is not None:
                yield model


def _count(folder: Path, content: Content) -> int:
    """Return the number of points or images of a model, which its file states or which are its lines; 0 without one."""
    file = _content_file(folder, content)
    if file is None:
        return 0
    try:
        if file.suffix == ".txt":
            return count_items(read_bytes(file, MAX_MODEL_BYTES), content)
        with open_regular(file) as stream:
            (count,) = struct.unpack("<Q", stream.read(8))
        return count if count * _ITEM_BYTES[content] <= file.stat().st_size else 0
    except (InputError, OSError, struct.error):
        return 0


def _content_file(folder: Path, content: Content) -> Path | None:
    """Return the file with the points or images of a model; None if there is none."""
    if content == "points":
        return points_file(folder)
    file = folder / ("images.bin" if has_entry(folder / "cameras.bin") else "images.txt")
    return file if has_entry(file) else None


def _describe(path: Path, models: list[_CountedModel], content: Content) -> str:
    """Name the models of a folder, the largest first, and the file that selects another one."""
    ordered = sorted(models, key=lambda model: model.size, reverse=True)
    named = [f"{_relative(path, model)} ({model.counts})" for model in ordered[:_MAX_NAMED]]
    rest = f" and {len(models) - _MAX_NAMED} more" if len(models) > _MAX_NAMED else ""
    option = "--cameras " if content == "images" else ""
    return (
        f"read the largest of {len(models)} COLMAP models: {', '.join(named)}{rest}; to read another one, name its"
        f" file, such as {option}{_content_file(ordered[1].folder, content)}"
    )


def _relative(path: Path, model: _CountedModel) -> str:
    return model.folder.relative_to(path).as_posix()
