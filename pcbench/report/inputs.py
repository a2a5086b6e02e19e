"""The input files of a comparison, recorded so that a report can name them and repeat it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pcbench.measure import results


@dataclass(frozen=True)
class InputFile:
    """An input file: its path as given, the SHA-256 of its bytes, and the warnings of its reader."""

    path: str
    sha256: str
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Inputs:
    """The input files of a comparison: reference, candidates by name, and files named in settings, such as a matrix."""

    reference: InputFile
    candidates: Mapping[str, InputFile] = field(default_factory=dict)
    files: tuple[InputFile, ...] = ()

    def all_files(self) -> tuple[InputFile, ...]:
        """Return all input files."""
        return (self.reference, *self.candidates.values(), *self.files)

    def paths(self) -> list[Path]:
        """Return the paths of all input files."""
        return [Path(file.path) for file in self.all_files()]


@dataclass(frozen=True, eq=False, repr=False)
class SourcedComparison(results.CandidateComparisons):
    """A measured comparison with its input files, from which all outputs are written.

    Attributes:
        inputs: the files; None if a cloud came from memory.
    """

    inputs: Inputs | None = None
