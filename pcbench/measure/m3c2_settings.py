"""The settings of M3C2: lengths, core points and the registration error, from Python or from text."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud, as_cloud


@dataclass(frozen=True, eq=False)
class M3C2Settings:
    """What M3C2 is computed with (Lague, Brodu & Leroux 2013, section 3); lengths in the clouds' unit.

    Attributes:
        radius: of the cylinders: half of the paper's projection scale d. None: 6 median spacings of the sparser cloud.
        depth: how far the cylinders reach to either side of a core point. None: the radius.
        normal_radius: of the ball about a core point whose reference points its normal is fitted to: half of the
            paper's normal scale D. Signs are those of the reference's normals, upwards where it came without. None:
            normals that come with the core points, else those of the reference at the point nearest to each.
        cores: the core points, in the reference's coordinates: a file, a cloud or an (N, 3) array. None: the
            reference's points, half a radius apart.
        registration_error: the paper's reg, added to the level of detection. None: what the registration predicts.

    Raises:
        InputError: a value is not usable.
    """

    radius: float | None = None
    depth: float | None = None
    normal_radius: float | None = None
    cores: Any = None
    registration_error: float | None = None

    def __post_init__(self) -> None:
        for name in ("radius", "depth", "normal_radius", "registration_error"):
            value = getattr(self, name)
            if value is None:
                continue
            is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            least = "a number of at least 0" if name == "registration_error" else "a positive number"
            if not is_number or not np.isfinite(value) or value < 0 or (value == 0 and name != "registration_error"):
                raise InputError(f"expected M3C2's {name} as {least}, got {value!r}")
        if isinstance(self.cores, str | PathLike):  # read when it is needed
            object.__setattr__(self, "cores", Path(self.cores))
        elif self.cores is not None:
            object.__setattr__(self, "cores", as_cloud(self.cores))

    @classmethod
    def parse(cls, text: str) -> M3C2Settings:
        """What `radius=0.5,depth=2,cores=FILE` stands for: names of the attributes, each at most once.

        Raises:
            InputError: a name is unknown or said twice, or a value is not usable.
        """
        names = [item.name for item in fields(cls)]
        values: dict[str, Any] = {}
        for part in re.split(r",(?=\s*[\w-]+=)", text):  # a file's name may hold commas
            name, equals, value = (piece.strip() for piece in part.partition("="))
            if not equals or name not in names:
                raise InputError(f"M3C2: expected NAME=VALUE with a name of {', '.join(names)}, got {part.strip()!r}")
            if name in values:
                raise InputError(f"M3C2: {name} is given twice")
            if not value:
                raise InputError(f"M3C2: expected a value after {name}=")
            values[name] = value if name == "cores" else _number(name, value)
        return cls(**values)

    @property
    def text(self) -> str:
        """As on the command line; core points that came from memory by their number."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        if isinstance(self.cores, Cloud):
            values["cores"] = f"<{len(self.cores)} points>"
        return ",".join(f"{name}={value}" for name, value in values.items() if value is not None)

    @property
    def file(self) -> Path | None:
        """Where the core points are to be read from, if from a file."""
        return self.cores if isinstance(self.cores, Path) else None

    def absolute(self) -> M3C2Settings:
        """The same from any folder."""
        return self if self.file is None else replace(self, cores=self.file.absolute())

    def read(self) -> M3C2Settings:
        """The same with the core points themselves.

        Raises:
            InputError: their file cannot be read.
        """
        if self.file is None:
            return self
        from pcbench.io import read_cloud

        return replace(self, cores=read_cloud(self.file))


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"expected M3C2's {name} as a number, got {text!r}") from None
