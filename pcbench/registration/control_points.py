"""Registration by pairs of named points: the best similarity, and the residuals of control and check points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError, reason_of
from pcbench.geometry.arrays import FloatArray, as_rows
from pcbench.geometry.transform import Similarity, fit_similarity
from pcbench.io.check_points import has_decimal_commas
from pcbench.io.text_layout import is_units_row
from pcbench.registration.given import method_files
from pcbench.registration.motion import MotionFrame, PoseCovariance
from pcbench.registration.residuals import SurveyResiduals
from pcbench.regular_files import read_text

_MIN_CONTROL_POINTS = 3  # needed to determine a similarity


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Registration method: pairs of points at the same place in both clouds.

    Attributes:
        candidate: (N, 3) points in candidate coordinates.
        reference: (N, 3) the same points in reference coordinates, in the same order.
        names: names of the pairs; 1, 2, ... if none are given.
        is_check: (N,) whether a pair is a check point, which is left out of the fit; none is, if not given.
        with_scale: whether the scale is solved for.
        z_is_up: whether z is height in the reference. If not, horizontal and vertical errors are not reported. Not
            needed if the reference has a projected coordinate system.
        text: method text for reports; for pairs from the command line, the text given there.

    Raises:
        InputError: the array shapes disagree, two pairs have the same name, or the control points do not determine the
            pose (see `fit_similarity`).
    """

    candidate: FloatArray
    reference: FloatArray
    names: Sequence[str] = ()
    is_check: NDArray[np.bool_] | None = None
    with_scale: bool = True
    z_is_up: bool = False
    text: str = "points"

    def __post_init__(self) -> None:
        candidate, reference = _points(self.candidate, "candidate"), _points(self.reference, "reference")
        count = len(candidate)
        names = tuple(self.names) or tuple(str(number) for number in range(1, count + 1))
        is_check = np.zeros(count, bool) if self.is_check is None else np.array(self.is_check, bool)
        if len(reference) != count or len(names) != count or is_check.shape != (count,):
            raise InputError(
                f"expected pairs of points: as many rows of candidate ({count}) as of reference ({len(reference)}),"
                f" names ({len(names)}) and is_check {is_check.shape}"
            )
        if twice := next((name for k, name in enumerate(names) if name in names[:k]), None):
            raise InputError(f"expected a different name for each pair of points, got {twice!r} twice")
        values = {"candidate": candidate, "reference": reference, "names": names, "is_check": is_check}
        for name, value in values.items():
            object.__setattr__(self, name, value)
        fit_pairs(self)  # fail now, before clouds are read, if the pairs do not determine the pose

    @property
    def files(self) -> tuple[Path, ...]:
        """File of pairs from the command line."""
        return method_files(self.text)

    @classmethod
    def read(cls, path: str | Path) -> ControlPoints:
        """Read pairs from a text file: the method `points:FILE`.

        Each line has a name, x y z in the candidate and x y z in the reference, between blanks, commas, semicolons or
        tabs; commas are decimal points unless they delimit. Names that end in * are check points. The comment `# z is
        up` states that the reference's z is height.

        Args:
            path: text file.

        Raises:
            InputError: the file has another format, or its pairs do not determine the pose.
        """
        names, rows, z_is_up = _read_rows(path)
        pairs = np.array(rows).reshape(-1, 6)
        is_check = np.array([name.endswith("*") for name in names], dtype=bool)
        try:
            bare = [name.rstrip("*") for name in names]
            return cls(pairs[:, :3], pairs[:, 3:], bare, is_check, z_is_up=z_is_up, text=f"points:{path}")
        except InputError as error:
            raise InputError(f"{path}: {error}") from error


def fit_pairs(pairs: ControlPoints) -> tuple[Similarity, SurveyResiduals]:
    """Fit the similarity candidate -> reference (Umeyama 1991) to the control points; return it and all residuals.

    Args:
        pairs: control and check points.

    Raises:
        InputError: there are fewer than three control points besides the check points, or all lie on one line.
    """
    is_check = np.zeros(len(pairs.candidate), bool) if pairs.is_check is None else pairs.is_check
    if is_check.any() and (control_count := int((~is_check).sum())) < _MIN_CONTROL_POINTS:
        raise InputError(
            f"expected at least {_MIN_CONTROL_POINTS} control points, got {control_count} beside {int(is_check.sum())}"
            " check points: the pose is fitted to control points alone"
        )
    T = fit_similarity(pairs.candidate[~is_check], pairs.reference[~is_check], with_scale=pairs.with_scale)
    differences = T.apply(pairs.candidate) - pairs.reference
    return T, SurveyResiduals.of(pairs.names, differences, is_check.tolist(), z_is_up=pairs.z_is_up)


def pose_covariance(pairs: ControlPoints, T: Similarity, origin: FloatArray) -> PoseCovariance:
    """Return the covariance of the pose that `fit_pairs` found, from the residuals of its control points.

    Args:
        pairs: control and check points.
        T: the fitted pose.
        origin: (3,) local origin of the reference.
    """
    is_control = np.ones(len(pairs.candidate), bool) if pairs.is_check is None else ~pairs.is_check
    moved = T.apply(pairs.candidate[is_control])
    frame = MotionFrame.of(moved - origin, np.ones(len(moved)))
    size = 7 if pairs.with_scale else 6
    rows = frame.jacobian(np.repeat(moved - origin, 3, axis=0), np.tile(np.eye(3), (len(moved), 1)))[:, :size]
    squares = float(np.square(moved - pairs.reference[is_control]).sum())
    variance = squares / (len(rows) - size)  # three control points leave at least two degrees of freedom
    matrix = variance * np.linalg.inv(rows.T @ rows).astype(np.float64)
    return PoseCovariance(frame, matrix, np.zeros((size, 0)))


def states_z_is_up(line: str) -> bool:
    """Return whether a line of a points file is the comment `# z is up`."""
    before, hash_sign, text = line.partition("#")
    return bool(hash_sign) and not before.strip() and text.lower().strip(" .").split() == ["z", "is", "up"]


def _points(values: ArrayLike, name: str) -> FloatArray:
    points = as_rows(f"the {name}'s control points", values).copy()
    if not np.isfinite(points).all():
        raise InputError(f"expected finite control points of the {name}, got NaN or Inf")
    return points


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _read_rows(path: str | Path) -> tuple[list[str], list[list[float]], bool]:
    """Return the names, the six coordinates per name, and whether a comment states that z is up."""
    try:
        lines = read_text(path).splitlines()
    except (InputError, OSError) as error:
        raise InputError(f"{path}: cannot read the pairs: {reason_of(error)}") from error
    names: list[str] = []
    rows: list[list[float]] = []
    z_is_up = any(states_z_is_up(line) for line in lines)
    texts = [line.split("#")[0].strip() for line in lines]
    decimal_comma = has_decimal_commas([text for text in texts if text])
    for number, (line, text) in enumerate(zip(lines, texts, strict=True), 1):
        words = text.replace(",", "." if decimal_comma else " ").replace(";", " ").split()
        if not words or (not rows and is_units_row(words)):
            continue
        try:
            rows.append([float(word) for word in words[1:]])
        except ValueError:
            if number == 1 and not any(map(_is_number, words[1:])):  # a header line
                continue
            raise InputError(
                f"{path}: line {number}: expected a name and six numbers, got {line.strip()!r}: correct the line"
            ) from None
        if len(words) == 4:
            raise InputError(
                f"{path}: line {number}: expected a name and six numbers (x y z in the candidate and in the reference),"
                f" got three: to register, add the other three; surveyed check points of one cloud are for pcbench"
                " checkpoints CLOUD FILE"
            )
        if len(words) != 7 or not np.isfinite(rows[-1]).all():
            raise InputError(f"{path}: line {number}: expected a name and six finite numbers, got {line.strip()!r}")
        names.append(words[0])
    return names, rows, z_is_up
