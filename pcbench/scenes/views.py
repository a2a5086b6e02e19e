"""A folder of rendered views: what a reconstructor of radiance makes of a scene's cameras, beside their photographs.

A reconstructor writes it (`write_views`), `pcbench views` measures it (`read_views`): neither knows the other. In it
are `views.json` and, of each view, `renderings/NAME.png`, `photographs/NAME.png` and, where not every pixel counts,
`masks/NAME.png`. The photograph is written too, because it is what the rendering was to be like: undistorted, and at
the size that was worked with.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.io.files import atomic_write, read_json
from pcbench.io.image_header import read_image_header
from pcbench.scenes.decode import decode_image, decode_mask
from pcbench.scenes.splits import Split

SCHEMA = "pcbench.views/1"
DOCUMENT = "views.json"
RENDERED = "rendered"  # the folder's name in a reconstructor's workspace


class Pictures(NamedTuple):
    """One view as it is compared.

    Attributes:
        name: of its image in the scene.
        rendering, photograph: (H, W, 3), uint8 or numbers, of which those from 0 to 1 are colours.
        mask: (H, W), which pixels count; None: all.
    """

    name: str
    rendering: NDArray[Any]
    photograph: NDArray[Any]
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class RenderedView:
    """One view of a folder: its files.

    Attributes:
        name: of its image in the scene.
        block: number of the run of held-out images that it is in; None: it was trained on.
        mask: None where every pixel counts.
    """

    name: str
    block: int | None
    rendering: Path
    photograph: Path
    mask: Path | None

    @property
    def is_test(self) -> bool:
        """Whether it was held out."""
        return self.block is not None

    def read(self) -> Pictures:
        """Its pictures, uint8.

        Raises:
            InputError: a file is missing or cannot be decoded, or they are of different sizes.
            MissingExtra: Pillow is not installed.
        """
        found = read_image_header(self.photograph)
        size = found.width, found.height
        for path in filter(None, (self.rendering, self.mask)):
            header = read_image_header(path)
            if (header.width, header.height) != size:
                raise InputError(
                    f"{path}: expected {size[0]} x {size[1]} pixels as the photograph has, got {header.width} x"
                    f" {header.height}"
                )
        mask = None if self.mask is None else decode_mask(self.mask, size)
        return Pictures(self.name, decode_image(self.rendering, size), decode_image(self.photograph, size), mask)


@dataclass(frozen=True)
class RenderedViews:
    """A folder of rendered views.

    Attributes:
        scene: what it is called in a table.
        method: what rendered them.
        split: in words, how images were held out.
        views: in the scene's order, those that were trained on first.
    """

    folder: Path
    scene: str
    method: str
    split: str
    views: tuple[RenderedView, ...]


def write_views(folder: Path, scene: str, method: str, split: Split, render: Callable[[str], Pictures]) -> None:
    """Write a folder that `read_views` reads. `views.json` comes last: a folder that has it is whole.

    Args:
        folder: where; made if need be. Files of the same names are replaced.
        scene, method: what they are called in a table.
        render: makes the pictures of a name of the split. One view at a time is in memory.

    Raises:
        InputError: pictures of a view are of different sizes or no images, or a name leads out of the folder.
        MissingExtra: Pillow is not installed.
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / DOCUMENT).unlink(missing_ok=True)  # of other pictures
    blocks = {name: number for number, block in enumerate(split.blocks) for name in block}
    rows = []
    for name in (*split.train, *split.test):
        pictures = render(name)
        sizes = {part.shape[:2] for part in pictures[1:] if part is not None}
        if len(sizes) != 1:
            raise InputError(f"{name}: expected a rendering, a photograph and a mask of one size, got {sorted(sizes)}")
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
    """The views of a folder that `write_views` wrote, or of a reconstructor's workspace that has one in it.

    Raises:
        InputError: there are none, or `views.json` is not what it has to be.
    """
    views_folder = find_views(folder)
    if views_folder is None:
        raise InputError(f"{folder}: expected a folder of rendered views (with {DOCUMENT}), or a workspace with one")
    path = views_folder / DOCUMENT
    try:
        document = read_json(path)
        if document["schema"] != SCHEMA:
            raise InputError(f"expected the schema {SCHEMA}, got {document['schema']!r}")
        views = tuple(_view(views_folder, row) for row in document["views"])
        scene, method, split = (str(document[key]) for key in ("scene", "method", "split"))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected what pcbench writes of rendered views, got {error!r}") from error
    if not views:
        raise InputError(f"{path}: expected at least one view, got none")
    return RenderedViews(views_folder, scene, method, split, views)


def find_views(folder: Path) -> Path | None:
    """The folder of rendered views that this is, or that is in it as in a workspace of a reconstructor."""
    candidates = (folder, folder / RENDERED, folder / "plugin" / RENDERED)
    return next((candidate for candidate in candidates if (candidate / DOCUMENT).is_file()), None)


def _view(folder: Path, row: Any) -> RenderedView:
    block = row["block"]
    if block is not None and (not isinstance(block, int) or isinstance(block, bool)):
        raise InputError(f"expected the block of a view as a number or null, got {block!r}")
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
        raise InputError(f"expected names of files in {folder}, got {name!r}")
    return path


def _to_uint8(image: NDArray[Any]) -> NDArray[np.uint8]:
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"expected an image of shape (height, width, 3), got {image.shape}")
    if image.dtype == np.uint8:
        return image
    if not np.isfinite(image).all():
        raise InputError("expected an image of finite numbers, got some that are not")
    levels: NDArray[np.uint8] = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
    return levels


def _write(path: Path, pixels: NDArray[np.uint8]) -> None:
    pillow = require("PIL.Image", "splat")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        pillow.fromarray(pixels).save(file, format="PNG", compress_level=1)
