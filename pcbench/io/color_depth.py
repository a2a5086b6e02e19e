"""Colours of LAS: fields of 16 bits, in which many programs store values of 8 bits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.io.files import Fields, Warn

DEPTHS = (8, 16)
_MAX_8_BITS = 255


def brightest(colors: NDArray[np.uint16]) -> int:
    """Return the largest value of colours (N, 3); 0 without points."""
    return int(colors.max(initial=0))


def apply_depth(files: Sequence[tuple[Path, Fields]], depth: int | None, warn: Warn) -> None:
    """Turn the 16-bit colours of all files of a cloud into 8-bit ones, in place.

    Without a given depth, all are 16-bit values if one exceeds 255, and 8-bit values otherwise. Points that a filter
    has removed count too, so that filters and tiles do not change colours.

    Args:
        files: the files, each with the fields that its reader returned.
        depth: significant bits of the stored values, 8 or 16; None: decide.
        warn: callback for warnings, without a path.

    Raises:
        InputError: the depth is neither 8 nor 16, or it is 8 and a value exceeds 255.
    """
    if depth not in (None, *DEPTHS):
        raise InputError(f"expected a colour depth of 8 or 16 bits, got {str(depth)[:40]}")
    wide = [(path, fields) for path, fields in files if "brightest" in fields]
    highest = max((fields["brightest"] for _, fields in wide), default=0)
    if depth == 8 and highest > _MAX_8_BITS:
        raise InputError(f"expected 8-bit colours from 0 to 255, got values up to {highest}: omit the colour depth")
    chosen = depth or (16 if highest > _MAX_8_BITS else 8)
    if depth is None and chosen == 8 and highest:
        warn(
            f"colours are at most {highest}, so they are read as 8-bit; if they are 16-bit: pcbench convert FILE OUT"
            " --color-depth 16"
        )
    dark = [path for path, fields in wide if 0 < fields["brightest"] <= _MAX_8_BITS]
    if depth is None and chosen == 16 and dark:
        warn(
            f"colours of {len(dark)} of {len(wide)} files, such as {dark[0].name}, are at most 255, but are read as"
            " 16-bit like the others; if they are 8-bit: pcbench convert FILE OUT --color-depth 8"
        )
    for _, fields in wide:
        del fields["brightest"]
        colors, stored = fields.get("colors"), fields.get("stored")
        assert colors is not None and stored is not None
        fields["colors"] = (colors >> 8 if chosen == 16 else colors).astype(np.uint8)
        fields["stored"] = stored._replace(color_depth=chosen)
