"""Read and write a folder of rendered views, each beside the photograph that it should reproduce.

A reconstructor writes the folder (`write_views`) and `pcbench views` evaluates it (`read_views`). The folder contains
`views.json` and, for each view, `renderings/NAME.png`, `photographs/NAME.png` and, if some pixels are excluded,
`masks/NAME.png`. The photograph is included because it is the target of the rendering: undistorted and at the working
size.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, describe_damage
from pcbench.extras import require
from pcbench.io.image_header import read_image_header
from pcbench.regular_files import read_json
from pcbench.scenes.decode import decode_image, decode_mask
from pcbench.scenes.splits import Split
from pcbench.scratch import atomic_write

SCHEMA = "pcbench.views/1"
DOCUMENT = "views.json"
VIEWS_FOLDER = "rendered"  # name of the folder in a reconstructor's workspace


class ViewImages(NamedTuple):
    """Rendering, photograph and mask of one view.

    Attributes:
        name: name of the image in the scene.
        rendering: rendered image (H, W, 3), uint8 or floats from 0 to 1.
        photograph: photograph (H, W, 3), uint8 or floats from 0 to 1.
        mask: valid pixels (H, W), or None if all are valid.
    """

    name: str
    rendering: NDArray[Any]
    photograph: NDArray[Any]
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class RenderedView:
    """Files of one view in a folder.

    Attributes:
        name: name of the image in the scene.
        block: index of its block of held-out images, or None for a training image.
        rendering: file of the rendered image.
        photograph: file of the photograph.
        mask: file of the mask, or None if all pixels are valid.
    """

    name: str
    block: int | None
    rendering: Path
    photograph: Path
    mask: Path | None

    @property
    def is_test(self) -> bool:
        """Return whether the view was held out."""
        return self.block is not None

    def read(self) -> ViewImages:
        """Read the images, as uint8.

        Raises:
            InputError: a file is missing, cannot be decoded, or has another size.
            MissingExtra: Pillow is not installed.
        """
        photograph_header = read_image_header(self.photograph)
        size = photograph_header.width, photograph_header.height
        for path in filter(None, (self.rendering, self.mask)):
            header = read_image_header(path)
            if (header.width, header.height) != size:
                raise InputError(
                    f"{path}: expected {size[0]} x {size[1]} pixels as the photograph, got {header.width} x"
                    f" {header.height}: render the views again"
                )
        mask = None if self.mask is None else decode_mask(self.mask, size)
        return ViewImages(self.name, decode_image(self.rendering, size), decode_image(self.photograph, size), mask)


@dataclass(frozen=True)
class RenderedViews:
    """Folder of rendered views.

    Attributes:
        folder: folder that contains views.json.
        scene: name of the scene, for tables.
        method: name of the method, for tables.
        split: description of the held-out images.
        views: training views in the scene's order, then held-out views block by block.
    """

    folder: Path
    scene: str
    method: str
    split: str
    views: tuple[RenderedView, ...]


def write_views(folder: Path, scene: str, method: str, split: Split, render: Callable[[str], ViewImages]) -> None:
    """Write a folder for `read_views`. `views.json` is written last, so a folder that has it is complete.

    Args:
        folder: output folder, created if it is missing; files of the same names are replaced.
        scene: name of the scene, for tables.
        method: name of the method, for tables.
        split: training and held-out images.
        render: function that returns the images of a view by name; one view at a time is in memory.

    Raises:
        InputError: the images of a view differ in size or are malformed, or a name points outside the folder.
        MissingExtra: Pillow is not installed.
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / DOCUMENT).unlink(missing_ok=True)  # describes the previous views
    blocks = {name: number for number, block in enumerate(split.blocks) for name in block}
    rows = []
    for name in (*split.train, *split.test):
        pictures = render(name)
        sizes = {part.shape[:2] for part in pictures[1:] if part is not None}
        if len(sizes) != 1:
            raise InputError(f"{name}: expected rendering, photograph and mask of one size, got {sorted(sizes)}")
        row: dict[str, Any] = {"name": name, "block": blocks.get(name)}
        for kind, image in (("rendering", pictures.rendering), ("photograph", pictures.photograph)):
            row[kind] = f"{kind}s/{name}.png"
            _write(_path_inside(folder, row[kind]), _to_uint8(image))
        if pictures.mask is not None:
            row["mask"] = f"masks/{name}.png"
            _write(_path_inside(folder, row["mask"]), pictures.mask.astype(np.uint8) * 255)
        rows.append(row)
    document = {"schema": SCHEMA, "scene": scene, "method": method, "split": split.words, "views": rows}
    with atomic_write(folder / DOCUMENT) as file:
        file.write((json.dumps(document, indent=1, ensure_ascii=False) + "\n").encode())


def read_views(folder: Path) -> RenderedViews:
    """Read a folder that `write_views` wrote, or the one inside a reconstructor's workspace.

    Raises:
        InputError: there is no such folder, or its `views.json` is malformed.
    """
    views_folder = find_views(folder)
    if views_folder is None:
        raise InputError(f"{folder}: expected a folder of rendered views (with {DOCUMENT}) or a workspace with one")
    path = views_folder / DOCUMENT
    try:
        document = read_json(path)
        if document["schema"] != SCHEMA:
            raise InputError(f"expected the schema {SCHEMA}, got {document['schema']!r}: render the views again")
        views = tuple(_view(views_folder, row) for row in document["views"])
        scene, method, split = (str(document[key]) for key in ("scene", "method", "split"))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected a file written by pcbench: {describe_damage(error)}: render the views again"
        ) from error
    if not views:
        raise InputError(f"{path}: expected at least one view, got none: render the views again")
    return RenderedViews(views_folder, scene, method, split, views)


def find_views(folder: Path) -> Path | None:
    """Return the folder of rendered views: this folder, or one inside it if it is a reconstructor's workspace."""
    candidates = (folder, folder / VIEWS_FOLDER, folder / "plugin" / VIEWS_FOLDER)
    return next((candidate for candidate in candidates if (candidate / DOCUMENT).is_file()), None)


def _view(folder: Path, row: Any) -> RenderedView:
    block = row["block"]
    if block is not None and (not isinstance(block, int) or isinstance(block, bool)):
        raise InputError(f"expected the block of a view as an integer or null, got {block!r}")
    mask = row.get("mask")
    return RenderedView(
        str(row["name"]),
        block,
        _path_inside(folder, row["rendering"]),
        _path_inside(folder, row["photograph"]),
        None if mask is None else _path_inside(folder, mask),
    )


def _path_inside(folder: Path, name: str) -> Path:
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"expected file names inside {folder}, got {name!r}: render the views again")
    return path


def _to_uint8(image: NDArray[Any]) -> NDArray[np.uint8]:
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"expected an image of shape (height, width, 3), got {image.shape}")
    if image.dtype == np.uint8:
        return image
    if not np.isfinite(image).all():
        raise InputError("expected an image of finite numbers, got NaN or Inf")
    levels: NDArray[np.uint8] = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
    return levels


def _write(path: Path, pixels: NDArray[np.uint8]) -> None:
    pillow = require("PIL.Image", "splat")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        pillow.fromarray(pixels).save(file, format="PNG", compress_level=1)
