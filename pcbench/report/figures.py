"""What a user may choose of pictures; stored with a report, so that they are drawn the same again."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pcbench.errors import InputError
from pcbench.regular_files import read_text

FORMATS = ("png", "svg", "pdf")
_NAMED = {"dark": "#1a1c20", "white": "#ffffff", "black": "#000000"}


@dataclass(frozen=True)
class Figures:
    """How pictures are drawn.

    Attributes:
        background: `dark`, `white`, `black` or `#rrggbb`; None: views of clouds are dark, charts white.
        range: the distance, in the reference's unit, at which colours end (from minus to plus it where distances are
            signed); None: found from the distances.
        format: `png`, `svg` or `pdf`. Clouds stay images inside the latter two; lines and words can be edited.

    Raises:
        InputError: a value is something else.
    """

    background: str | None = None
    range: float | None = None
    format: str = "png"

    def __post_init__(self) -> None:
        given = self.background
        known = given is None or (
            isinstance(given, str) and (given in _NAMED or re.fullmatch("#[0-9a-fA-F]{6}", given))
        )
        if not known:
            raise InputError(f"expected the background as {', '.join(_NAMED)} or #rrggbb, got {given!r}")
        if self.range is not None and not (_is_number(self.range) and math.isfinite(self.range) and self.range > 0):
            raise InputError(f"expected the range of colours as a positive length, got {self.range!r}")
        if self.format not in FORMATS:
            raise InputError(f"expected pictures as {', '.join(FORMATS)}, got {self.format!r}")

    def ground(self, otherwise: str) -> str:
        """The background as #rrggbb; `otherwise` names the one of a picture for which the user chose none."""
        name = self.background or otherwise
        return _NAMED.get(name, name)

    def changed(self, background: str | None, range: float | None, format: str | None) -> Figures:
        """With what a user chose instead; None: as it is."""
        return Figures(
            self.background if background is None else background,
            self.range if range is None else range,
            self.format if format is None else format,
        )

    def plain(self) -> dict[str, Any]:
        """As JSON holds it: `Figures(**plain)` is the same again."""
        return asdict(self)


def recorded_figures(settings_file: Path) -> Figures:
    """Those that a report's settings.json has; the usual ones where there are none."""
    try:
        return Figures(**json.loads(read_text(settings_file)).get("figures", {}))
    except (OSError, AttributeError, TypeError, ValueError, RecursionError):
        return Figures()


def record_figures(settings_file: Path, figures: Figures) -> None:
    """A settings.json that holds nothing else."""
    settings_file.write_text(json.dumps({"figures": figures.plain()}, indent=2) + "\n", encoding="utf-8")


def ink(ground: str) -> str:
    """The colour of words and lines that are read on a background #rrggbb."""
    red, green, blue = (int(ground[k : k + 2], 16) / 255 for k in (1, 3, 5))
    # Rec. 709 luma: what decides is how light it looks.
    return "#1b1c1e" if 0.2126 * red + 0.7152 * green + 0.0722 * blue > 0.5 else "#e8e8e6"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
