"""Given poses: the types accepted where a pose is expected, and the method that uses a given pose unchanged."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.transform import Similarity, read_matrix


@dataclass(frozen=True, eq=False)
class GivenPose:
    """Registration method: a known pose is used unchanged, and only its fit is assessed.

    Attributes:
        T_reference_candidate: transform from candidate to reference coordinates, as a `Similarity` or a 4x4 array.
        text: method text for reports; for a pose from the command line, the text given there.

    Raises:
        InputError: the array is not a rotation with a positive scale and a translation.
    """

    T_reference_candidate: Similarity
    text: str = "matrix"

    with_scale: ClassVar[bool] = False  # a given scale is not solved for

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_reference_candidate", as_similarity(self.T_reference_candidate))

    @property
    def files(self) -> tuple[Path, ...]:
        """File of a pose from the command line."""
        return method_files(self.text)

    @classmethod
    def identity(cls) -> GivenPose:
        """Return the identity pose: the method `none`."""
        return cls(Similarity.identity(), "none")

    @classmethod
    def read(cls, path: str | Path) -> GivenPose:
        """Read a text file with the 4x4 matrix: the method `matrix:FILE`.

        Args:
            path: text file.

        Raises:
            InputError: the file does not contain such a matrix.
        """
        return cls(read_matrix(path), f"matrix:{path}")


def method_files(text: str) -> tuple[Path, ...]:
    """Return the files and folders of a method text such as `points:FILE`; empty for methods without files."""
    kind, _, names = text.partition(":")
    if not names or kind not in ("points", "matrix", "tnt"):
        return ()
    return tuple(map(Path, names.split(",")[:2] if kind == "tnt" else [names]))


def absolute_text(text: str) -> str:
    """Return a method text with the absolute paths of its files."""
    files = method_files(text)
    kind, _, names = text.partition(":")
    others = names.split(",")[2:] if kind == "tnt" else []
    return f"{kind}:{','.join([*(str(file.absolute()) for file in files), *others])}" if files else text


def as_similarity(pose: Similarity | ArrayLike) -> Similarity:
    """Convert a pose, a `Similarity` or a 4x4 array, to a `Similarity`.

    Args:
        pose: similarity transform.

    Raises:
        InputError: the array has another shape, is a reflection, shears, or contains non-finite or non-numeric values.
    """
    if isinstance(pose, Similarity):
        return pose
    try:
        return Similarity.from_matrix(pose)
    except InputError as error:
        raise InputError(f"not the matrix of a similarity: {error}") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"expected a Similarity or a 4x4 array of numbers, got {type(pose).__name__}") from error
