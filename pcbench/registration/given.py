"""Poses from elsewhere: what may be handed in where a pose is expected, and the method that takes one as it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.transform import Similarity, read_matrix


@dataclass(frozen=True, eq=False)
class GivenPose:
    """A registration method: the candidate is placed by a pose that is known already, and the fit is only assessed.

    Attributes:
        T_reference_candidate: a `Similarity`, or the 4x4 array of one; maps candidate to reference coordinates.
        text: for reports; for a pose from the command line what stood there.

    Raises:
        InputError: the array is not a rotation with a positive scale and a translation.
    """

    T_reference_candidate: Similarity
    text: str = "matrix"

    with_scale: ClassVar[bool] = False  # a scale that is given is not solved for

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_reference_candidate", as_similarity(self.T_reference_candidate))

    @classmethod
    def identity(cls) -> GivenPose:
        """The candidate as it stands: the method `none`."""
        return cls(Similarity.identity(), "none")

    @classmethod
    def read(cls, path: str | Path) -> GivenPose:
        """From a text file with the 4x4 matrix: the method `matrix:FILE`.

        Raises:
            InputError: the file is not such a matrix.
        """
        return cls(read_matrix(path), f"matrix:{path}")


def as_similarity(pose: Similarity | ArrayLike) -> Similarity:
    """A pose as a `Similarity`; a 4x4 array has to be one.

    Raises:
        InputError: it has another shape, is a reflection, shears, or holds what is no number.
    """
    if isinstance(pose, Similarity):
        return pose
    try:
        return Similarity.from_matrix(pose)
    except InputError as error:
        raise InputError(f"not the matrix of a similarity: {error}") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"expected a Similarity or a 4x4 array of numbers, got {type(pose).__name__}") from error
