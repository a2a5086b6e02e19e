"""Which files a comparison read, so that a report can say so and be made again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path


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
