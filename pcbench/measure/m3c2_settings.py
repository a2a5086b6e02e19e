"""Settings of M3C2: lengths, core points and registration error, from Python or from text."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError, did_you_mean
from pcbench.geometry.cloud import Cloud, as_cloud


@dataclass(frozen=True, eq=False)
class M3C2Settings:
    """Settings of M3C2 (Lague, Brodu & Leroux 2013, section 3), with lengths in the clouds' unit.

    Attributes:
        radius: radius of the cylinders, half of the paper's projection scale d. None: 6 median spacings of the sparser
            cloud.
        depth: extent of the cylinders to either side of a core point. None: the radius.
        normal_radius: radius of the ball of reference points to which the normal of a core point is fitted, half of the
            paper's normal scale D. Its sign is that of the reference's normal, upwards if the reference had none. None:
            the normals in the file of core points, otherwise those of the closest reference points.
        cores: core points in the reference's coordinates: a file, a cloud or an (N, 3) array. None: points of the
            reference at half a radius from each other.
        registration_error: the paper's reg, which is added to the level of detection. None: the registration's
        estimate.

    Raises:
        InputError: a value is invalid.
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
            expected = "a number of at least 0" if name == "registration_error" else "a positive number"
            if not is_number or not np.isfinite(value) or value < 0 or (value == 0 and name != "registration_error"):
                raise InputError(f"expected M3C2's {name} as {expected}, got {value!r}")
        if isinstance(self.cores, str | PathLike):  # read on use
            object.__setattr__(self, "cores", Path(self.cores))
        elif self.cores is not None:
            object.__setattr__(self, "cores", as_cloud(self.cores))

    @classmethod
    def parse(cls, text: str) -> M3C2Settings:
        """Parse a text such as `radius=0.5,depth=2,cores=FILE`, with each attribute at most once.

        Raises:
            InputError: a name is unknown or repeated, or a value is invalid.
        """
        names = [item.name for item in fields(cls)]
        values: dict[str, Any] = {}
        for part in re.split(r",(?=\s*[\w-]+=)", text):  # a file name may have commas
            name, equals, value = (piece.strip() for piece in part.partition("="))
            if not equals or name not in names:
                hint = did_you_mean(name, names)
                raise InputError(
                    f"M3C2: expected NAME=VALUE with a name of {', '.join(names)}, got {part.strip()!r}{hint}"
                )
            if name in values:
                raise InputError(f"M3C2: expected {name} once, got it twice")
            if not value:
                raise InputError(f"M3C2: expected a value after {name}=")
            values[name] = value if name == "cores" else _number(name, value)
        return cls(**values)

    @property
    def text(self) -> str:
        """The settings as on the command line; core points from memory are given as their number."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        if isinstance(self.cores, Cloud):
            values["cores"] = f"<{len(self.cores)} points>"
        return ",".join(f"{name}={value}" for name, value in values.items() if value is not None)

    @property
    def file(self) -> Path | None:
        """File of the core points, if they come from one."""
        return self.cores if isinstance(self.cores, Path) else None

    def absolute(self) -> M3C2Settings:
        """Return the settings with an absolute path."""
        return self if self.file is None else replace(self, cores=self.file.absolute())

    def read(self) -> M3C2Settings:
        """Return the settings with the core points read from their file.

        Raises:
            InputError: the file cannot be read.
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
