"""The files that a comparison read, so that a report can name them and be made again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pcbench.measure import results


@dataclass(frozen=True)
class InputFile:
    """A file that was read: its path as given, the digest of its bytes, and what its reader had to say."""

    path: str
    sha256: str
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Inputs:
    """Of a comparison: the reference, each candidate by name, and what settings name, such as a matrix."""

    reference: InputFile
    candidates: Mapping[str, InputFile] = field(default_factory=dict)
    files: tuple[InputFile, ...] = ()

    def all(self) -> tuple[InputFile, ...]:
        return (self.reference, *self.candidates.values(), *self.files)

    def paths(self) -> list[Path]:
        return [Path(file.path) for file in self.all()]


@dataclass(frozen=True, eq=False, repr=False)
class SourcedComparison(results.CandidateComparisons):
    """A measured comparison and the files that its clouds came from: what every output is written from.

    Attributes:
        inputs: the files; None where a cloud came from memory.
    """

    inputs: Inputs | None = None
