"""Pictures inside a page, as data: as they were drawn if the page stays small, else with fewer colours or pixels."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from pcbench.extras import import_problem

MAX_BYTES = 2_900_000  # of all pictures of a page; base64 makes them a third larger
_COLORS = 256
_MIN_WIDTH = 600  # pixels; a chart that is smaller cannot be read
_SHRINKING = 0.8  # ratio of widths of successive trials
_SIZE_AT = slice(16, 24)  # of a PNG file: width and height, big-endian


class EmbeddedPicture(NamedTuple):
    """A picture for a page.

    Attributes:
        data: the picture as an address with its content; empty if it is left out.
        width: width in pixels.
        height: height in pixels.
        note: what was changed, and which file has the picture as it was drawn; empty if nothing was.
    """

    data: str
    width: int
    height: int
    note: str = ""


def embed(folder: Path, files: Sequence[str], limit: int = MAX_BYTES) -> dict[str, EmbeddedPicture]:
    """Return pictures for a page by file.

    Args:
        folder: folder of the files.
        files: PNG files, relative to the folder.
        limit: number of bytes of all pictures together. Budget that small pictures do not use goes to larger ones.

    Raises:
        OSError: a file cannot be read.
    """
    contents = {file: (folder / file).read_bytes() for file in files}
    pictures: dict[str, EmbeddedPicture] = {}
    for number, (file, content) in enumerate(sorted(contents.items(), key=lambda item: len(item[1]))):
        share = limit // (len(contents) - number)
        picture = content if len(content) <= share else _reduced(content, share)
        width, height = (int.from_bytes(content[_SIZE_AT][k : k + 4], "big") for k in (0, 4))
        if picture is None:
            pictures[file] = EmbeddedPicture("", width, height, f"Too large for this page: see the file {file}.")
            continue
        limit -= len(picture)
        data = f"data:image/png;base64,{base64.b64encode(picture).decode()}"
        note = "" if picture is content else f"Reduced for this page; as drawn: {file}."
        pictures[file] = EmbeddedPicture(data, width, height, note)
    return pictures


def _reduced(content: bytes, limit: int) -> bytes | None:
    """Return a picture with 256 colours and, if necessary, fewer pixels; None if it cannot be made small enough."""
    if import_problem("PIL.Image"):
        return None
    from PIL import Image

    with Image.open(io.BytesIO(content)) as opened:
        whole = opened.convert("RGB")
    width = float(whole.width)
    while width >= min(_MIN_WIDTH, whole.width):
        size = (round(width), max(1, round(whole.height * width / whole.width)))
        made = io.BytesIO()
        # An octree is fast, and keeps rare colours, such as those of a colour bar.
        few = whole.resize(size, Image.Resampling.LANCZOS).quantize(_COLORS, Image.Quantize.FASTOCTREE)
        few.save(made, "PNG", optimize=True)
        if made.tell() <= limit:
            return made.getvalue()
        width *= _SHRINKING
    return None
