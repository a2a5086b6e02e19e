"""Residuals of surveyed points: control points, which the fit used, and check points, which it did not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray


class PointResidual(NamedTuple):
    """Residual of a named point, measured minus surveyed position, along x, y and z."""

    name: str
    dx: float
    dy: float
    dz: float

    @property
    def error(self) -> float:
        """Distance from the surveyed position."""
        return float(np.linalg.norm(self[1:]))


class PointRmse(NamedTuple):
    """Root mean square errors of a set of points: 3D, horizontal and vertical.

    The last two are None if z is not known to be up.
    """

    points: int
    total: float
    horizontal: float | None
    vertical: float | None


@dataclass(frozen=True)
class SurveyResiduals:
    """Residuals of control and check points, in the coordinates of the survey.

    Attributes:
        control: residuals of points that the pose was fitted to; they underestimate its errors.
        check: residuals of points that were left out of the fit.
        z_is_up: whether z is known to be height, so that horizontal and vertical errors can be separated.
    """

    control: tuple[PointResidual, ...] = ()
    check: tuple[PointResidual, ...] = ()
    z_is_up: bool = False

    @classmethod
    def of(
        cls, names: Sequence[str], residuals: FloatArray, is_check: Sequence[bool], *, z_is_up: bool
    ) -> SurveyResiduals:
        """Sort the residuals (N, 3) of named points into control and check points."""
        points = [PointResidual(name, *map(float, row)) for name, row in zip(names, residuals, strict=True)]
        control = tuple(point for point, check in zip(points, is_check, strict=True) if not check)
        checks = tuple(point for point, check in zip(points, is_check, strict=True) if check)
        return cls(control, checks, z_is_up)

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> SurveyResiduals:
        """Restore residuals from the values of `plain`.

        Args:
            values: values as `plain` returns them.

        Raises:
            KeyError, TypeError, ValueError: the values have another form.
        """
        control, check = (
            tuple(PointResidual(str(row["name"]), *(float(row[axis]) for axis in ("dx", "dy", "dz"))) for row in rows)
            for rows in (values["control_points"], values["check_points"])
        )
        return cls(control, check, bool(values["z_is_up"]))

    def __bool__(self) -> bool:
        return bool(self.control or self.check)

    def rmse(self, points: Sequence[PointResidual]) -> PointRmse | None:
        """Root mean square errors of a set of points, such as `control` or `check`; None if it is empty."""
        if not points:
            return None
        squares = np.square([point[1:] for point in points]).mean(axis=0)
        horizontal, vertical = float(np.sqrt(squares[0] + squares[1])), float(np.sqrt(squares[2]))
        total = float(np.sqrt(squares.sum()))
        return PointRmse(len(points), total, *((horizontal, vertical) if self.z_is_up else (None, None)))

    def plain(self) -> dict[str, Any]:
        """JSON-ready values: all points, the root mean square errors per kind, and whether z is up."""

        def rows(points: Sequence[PointResidual]) -> list[dict[str, Any]]:
            return [{"name": point.name, "error": point.error, **point._asdict()} for point in points]

        rmse = {"control": self.rmse(self.control), "check": self.rmse(self.check)}
        return {
            "control_points": rows(self.control),
            "check_points": rows(self.check),
            "point_rmse": {kind: None if each is None else each._asdict() for kind, each in rmse.items()},
            "z_is_up": self.z_is_up,
        }

    def point_lines(self, unit: str | None = None) -> Iterator[str]:
        """Yield one line per point for printing."""
        of_unit = f" {unit}" if unit else ""
        for kind, points in (("control", self.control), ("check", self.check)):
            for point in points:
                yield (
                    f"{kind} point {point.name}: {point.error:.4g}{of_unit}"
                    f" (dx {point.dx:+.4g}, dy {point.dy:+.4g}, dz {point.dz:+.4g})"
                )

    def rmse_lines(self, unit: str | None = None) -> Iterator[str]:
        """Yield one line per kind of point with its root mean square errors for printing."""
        of_unit = f" {unit}" if unit else ""
        for kind, points in (("control", self.control), ("check", self.check)):
            rmse = self.rmse(points)
            if rmse is None:
                continue
            parts = [f"3D {rmse.total:.4g}{of_unit}"]
            if rmse.horizontal is not None and rmse.vertical is not None:
                parts = [f"H {rmse.horizontal:.4g}{of_unit}", f"Z {rmse.vertical:.4g}{of_unit}", *parts]
            yield f"{rmse.points} {kind} point{'s' if rmse.points > 1 else ''}: RMSE {', '.join(parts)}"
        if self and not self.z_is_up:
            yield "no H and Z: z is not known to be up (state it by a line `# z is up` in the points file)"
