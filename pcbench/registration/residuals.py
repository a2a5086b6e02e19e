"""Residuals of surveyed points: control points, which a fit used, and check points, which it did not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray


class PointResidual(NamedTuple):
    """The residual of a named point: where it was measured minus where it was surveyed, along x, y and z."""

    name: str
    dx: float
    dy: float
    dz: float

    @property
    def error(self) -> float:
        """Distance from the surveyed position."""
        return float(np.linalg.norm(self[1:]))


class PointRmse(NamedTuple):
    """Root mean square errors of some points: of the 3D distances, and of their parts across z and along z.

    The last two are None where z is not known to be up.
    """

    points: int
    total: float
    horizontal: float | None
    vertical: float | None


@dataclass(frozen=True)
class SurveyResiduals:
    """Residuals of control and check points, in coordinates of the survey.

    Attributes:
        control: of the points that the pose was fitted to: they understate its errors.
        check: of the points that were measured and took no part in the fit.
        z_is_up: whether z is known to be height, so that horizontal and vertical errors can be told apart.
    """

    control: tuple[PointResidual, ...] = ()
    check: tuple[PointResidual, ...] = ()
    z_is_up: bool = False

    @classmethod
    def of(
        cls, names: Sequence[str], residuals: FloatArray, is_check: Sequence[bool], *, z_is_up: bool
    ) -> SurveyResiduals:
        """The residuals (N, 3) of named points, sorted into control and check points."""
        points = [PointResidual(name, *map(float, row)) for name, row in zip(names, residuals, strict=True)]
        control = tuple(point for point, check in zip(points, is_check, strict=True) if not check)
        checks = tuple(point for point, check in zip(points, is_check, strict=True) if check)
        return cls(control, checks, z_is_up)

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> SurveyResiduals:
        """The inverse of `plain`.

        Raises:
            KeyError, TypeError, ValueError: the values are something else.
        """
        control, check = (
            tuple(PointResidual(str(row["name"]), *(float(row[axis]) for axis in ("dx", "dy", "dz"))) for row in rows)
            for rows in (values["control_points"], values["check_points"])
        )
        return cls(control, check, bool(values["z_is_up"]))

    def __bool__(self) -> bool:
        return bool(self.control or self.check)

    def rmse(self, points: Sequence[PointResidual]) -> PointRmse | None:
        """Root mean square errors of the control or of the check points; None where there are none."""
        if not points:
            return None
        squares = np.square([point[1:] for point in points]).mean(axis=0)
        horizontal, vertical = float(np.sqrt(squares[0] + squares[1])), float(np.sqrt(squares[2]))
        total = float(np.sqrt(squares.sum()))
        return PointRmse(len(points), total, *((horizontal, vertical) if self.z_is_up else (None, None)))

    def plain(self) -> dict[str, Any]:
        """JSON-ready values: every point, the root mean square errors of both kinds, and whether z is up."""

        def rows(points: Sequence[PointResidual]) -> list[dict[str, Any]]:
            return [{"name": point.name, "error": point.error, **point._asdict()} for point in points]

        rmse = {"control": self.rmse(self.control), "check": self.rmse(self.check)}
        return {
            "control_points": rows(self.control),
            "check_points": rows(self.check),
            "point_rmse": {kind: None if found is None else found._asdict() for kind, found in rmse.items()},
            "z_is_up": self.z_is_up,
        }

    def point_lines(self) -> Iterator[str]:
        """One line per point, for people."""
        for kind, points in (("control", self.control), ("check", self.check)):
            for point in points:
                yield (
                    f"{kind} point {point.name}: {point.error:.4g}"
                    f" (dx {point.dx:+.4g}, dy {point.dy:+.4g}, dz {point.dz:+.4g})"
                )

    def rmse_lines(self, unit: str | None = None) -> Iterator[str]:
        """One line per kind of point with its root mean square errors, for people."""
        of_unit = f" {unit}" if unit else ""
        for kind, points in (("control", self.control), ("check", self.check)):
            found = self.rmse(points)
            if found is None:
                continue
            parts = [f"3D {found.total:.4g}{of_unit}"]
            if found.horizontal is not None and found.vertical is not None:
                parts = [f"H {found.horizontal:.4g}{of_unit}", f"Z {found.vertical:.4g}{of_unit}", *parts]
            yield f"{found.points} {kind} point{'s' if found.points > 1 else ''}: RMSE {', '.join(parts)}"
        if self and not self.z_is_up:
            yield "no H and Z: z is not known to be up (a line `# z is up` in the file of points states it)"
