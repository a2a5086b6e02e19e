"""Discrete colours of integer attributes with few values, such as the classes of LAS files."""

from __future__ import annotations

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.report.colors import SEQUENTIAL, Classes

CLASSIFICATION = "classification"
"""Attribute with the classes of LAS files."""

_MAX_CLASSES = 12
# Names of the standard point classes (ASPRS, LAS 1.4, revision 15), and a colour for each.
_STANDARD = {
    0: ("never classified", (112, 112, 112)),
    1: ("unclassified", (170, 170, 170)),
    2: ("ground", (176, 122, 66)),
    3: ("low vegetation", (190, 222, 120)),
    4: ("medium vegetation", (104, 184, 84)),
    5: ("high vegetation", (24, 128, 68)),
    6: ("building", (222, 72, 60)),
    7: ("low noise", (255, 90, 200)),
    8: ("model key-point", (255, 255, 255)),
    9: ("water", (72, 138, 226)),
    10: ("rail", (150, 110, 190)),
    11: ("road surface", (96, 104, 128)),
    12: ("overlap", (214, 206, 150)),
    13: ("wire: shield", (255, 214, 92)),
    14: ("wire: conductor", (255, 186, 40)),
    15: ("transmission tower", (240, 148, 60)),
    16: ("wire: insulator", (206, 150, 30)),
    17: ("bridge deck", (120, 214, 214)),
    18: ("high noise", (200, 60, 170)),
    19: ("overhead structure", (230, 130, 130)),
    20: ("ignored ground", (128, 92, 58)),
    21: ("snow", (226, 240, 250)),
    22: ("temporal exclusion", (80, 80, 160)),
}


def classes_of(name: str, values: FloatArray, *, is_integer: bool) -> Classes | None:
    """Return the colours of an attribute's values if they are few integers, else None.

    The colours of LAS classes suggest what they are; those of other values follow their order.

    Args:
        name: name of the attribute.
        values: (N,) its values, NaN if unknown.
        is_integer: whether the attribute is stored as integers; LAS classes need not be.
    """
    if not (is_integer or name == CLASSIFICATION):
        return None
    distinct = np.unique(values[np.isfinite(values)])
    if not 0 < len(distinct) <= _MAX_CLASSES or (distinct != np.rint(distinct)).any():
        return None
    codes = [int(value) for value in distinct]
    evenly = SEQUENTIAL[np.rint(np.linspace(0, len(SEQUENTIAL) - 1, len(codes))).astype(np.int64)]
    if name != CLASSIFICATION:
        return Classes(distinct, tuple(map(str, codes)), evenly)
    standard = [_STANDARD.get(code) for code in codes]
    names = [str(code) if entry is None else f"{code} {entry[0]}" for code, entry in zip(codes, standard, strict=True)]
    table = [color if entry is None else entry[1] for color, entry in zip(evenly, standard, strict=True)]
    return Classes(distinct, tuple(names), np.array(table, dtype=np.float64))
