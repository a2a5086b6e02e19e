"""Settings of the registration method ICP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from pcbench.errors import InputError
from pcbench.registration.weighted_pairs import MIN_POINTS


@dataclass(frozen=True)
class IcpSettings:
    """Registration method: coarse-to-fine ICP. The defaults are those of `icp` on the command line.

    Attributes:
        residuals: `plane` (to the reference's tangent planes) or `point` (to its points; less accurate; `icp-point`).
        with_scale: whether the scale is refined too (`similarity`); it must be nearly right at the start.
        max_correspondence_distance: initial maximum distance of correspondences, in the reference's unit. None: a tenth
            of the reference's extent. It narrows to three point spacings of the reference.
        max_iterations: maximum iterations of each of the two stages.
        max_sample: maximum number of candidate points, evenly spread, in the fine stage. The default gives millimetre
            accuracy within seconds.

    Raises:
        InputError: a value is not usable.
    """

    residuals: Literal["plane", "point"] = "plane"
    with_scale: bool = False
    max_correspondence_distance: float | None = None
    max_iterations: int = 100
    max_sample: int = 30_000

    files: ClassVar[tuple[()]] = ()

    def __post_init__(self) -> None:
        if self.residuals not in ("plane", "point"):
            raise InputError(f"expected the residuals `plane` or `point`, got {self.residuals!r}")
        if not isinstance(self.with_scale, bool):
            raise InputError(f"expected with_scale as True or False, got {self.with_scale!r}")
        if self.with_scale and self.residuals == "point":
            raise InputError("expected residuals `plane` with with_scale=True: with `point` the scale would shrink")
        distance = self.max_correspondence_distance
        if distance is not None and not (
            isinstance(distance, int | float | np.number) and np.isfinite(distance) and distance > 0
        ):
            raise InputError(f"expected a positive max_correspondence_distance, got {distance!r}")
        for name, least in (("max_iterations", 1), ("max_sample", MIN_POINTS)):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
                raise InputError(f"expected {name} as an integer of at least {least}, got {value!r}")

    @property
    def text(self) -> str:
        """Method name as on the command line, followed by the values that differ from the defaults."""
        name = "similarity" if self.with_scale else "icp-point" if self.residuals == "point" else "icp"
        default = IcpSettings()
        numbers = ("max_correspondence_distance", "max_iterations", "max_sample")
        changed = [
            f"{number}={getattr(self, number)}"
            for number in numbers
            if getattr(self, number) != getattr(default, number)
        ]
        return f"{name} ({', '.join(changed)})" if changed else name
