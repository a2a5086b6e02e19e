"""Parts of the articles of studies."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath

from pcbench.report.article import Figure


def drawn_pictures(files: Sequence[str], captions: Mapping[str, str], *names: str) -> Iterator[Figure]:
    """Yield those of a study's pictures that were drawn, in the order of `names`, with their captions.

    Args:
        files: files of all pictures, relative to the study's folder.
        captions: captions by name, which is a file's name without its extension.
        names: names of the pictures.
    """
    drawn = {PurePath(file).stem: file for file in files}
    yield from (Figure(drawn[name], captions[name]) for name in names if name in drawn)
