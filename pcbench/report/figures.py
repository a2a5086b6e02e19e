"""Appearance of pictures, as the user sets it; stored with a report so that its pictures can be repeated."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, dataclass, fields
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.regular_files import read_json

FORMATS = ("png", "svg", "pdf")
WINDOW_SIZE = (1200, 800)  # of views in three dimensions, in pixels
_BACKGROUNDS = {"dark": "#1a1c20", "white": "#ffffff", "black": "#000000"}


@dataclass(frozen=True)
class Figures:
    """Appearance of pictures.

    Attributes:
        background: `dark`, `white`, `black` or `#rrggbb`; None: dark for views of clouds, white for charts.
        range: the distance at which the colour range ends, in the reference's unit; signed distances range from minus
            to plus this value. None: chosen from the distances.
        format: `png`, `svg` or `pdf`. In svg and pdf, text and lines stay editable, and clouds are embedded images.

    Raises:
        InputError: a value is invalid.
    """

    background: str | None = None
    range: float | None = None
    format: str = "png"

    def __post_init__(self) -> None:
        color = self.background
        is_color = color is None or (
            isinstance(color, str) and (color in _BACKGROUNDS or re.fullmatch("#[0-9a-fA-F]{6}", color))
        )
        if not is_color:
            raise InputError(f"expected the background as {', '.join(_BACKGROUNDS)} or #rrggbb, got {color!r}")
        if self.range is not None and not (_is_number(self.range) and math.isfinite(self.range) and self.range > 0):
            raise InputError(f"expected the colour range as a positive length, got {self.range!r}")
        if self.format not in FORMATS:
            raise InputError(f"expected the format of pictures as {', '.join(FORMATS)}, got {self.format!r}")

    def ground(self, otherwise: str) -> str:
        """Return the background as #rrggbb; `otherwise` is the default of a picture."""
        name = self.background or otherwise
        return _BACKGROUNDS.get(name, name)

    def with_changes(self, background: str | None, range: float | None, format: str | None) -> Figures:
        """Return a copy with some values replaced; None keeps a value."""
        return Figures(
            self.background if background is None else background,
            self.range if range is None else range,
            self.format if format is None else format,
        )

    def plain(self) -> dict[str, Any]:
        """Return the values for JSON; `Figures(**plain)` restores them."""
        return {**asdict(self), "range": None if self.range is None else float(self.range)}


def recorded_figures(settings_file: Path) -> Figures:
    """Return the appearance recorded in a report's settings.json; the default if there is no such file or record.

    Raises:
        InputError: the file or the record is damaged.
    """
    try:
        settings = read_json(settings_file)
    except FileNotFoundError:
        return Figures()
    except InputError as error:
        raise InputError(f"{settings_file}: {error}") from error
    try:
        return _figures(settings.get("figures", {}) if isinstance(settings, dict) else settings)
    except InputError as error:
        raise InputError(f'{settings_file}: {error}: correct "figures" in the file, or remove it') from error


def _figures(recorded: Any) -> Figures:
    if not isinstance(recorded, dict):
        raise InputError(f"expected the appearance of pictures as an object, got {recorded!r}")
    names = [item.name for item in fields(Figures)]
    if unknown := [name for name in recorded if name not in names]:
        raise InputError(f"expected {', '.join(names)} as appearance of pictures, got {unknown[0]!r}")
    return Figures(**recorded)


def record_figures(settings_file: Path, figures: Figures) -> None:
    """Write a settings.json that contains only the appearance of pictures."""
    settings_file.write_text(json.dumps({"figures": figures.plain()}, indent=2) + "\n", encoding="utf-8")


def rgb(color: str) -> NDArray[np.uint8]:
    """Return red, green and blue (3,) of a colour #rrggbb."""
    return np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)], dtype=np.uint8)


def ink(ground: str) -> str:
    """Return a readable colour for text and lines on a background #rrggbb."""
    red, green, blue = rgb(ground) / 255
    # Rec. 709 luma approximates the perceived lightness.
    return "#1b1c1e" if 0.2126 * red + 0.7152 * green + 0.0722 * blue > 0.5 else "#e8e8e6"


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
