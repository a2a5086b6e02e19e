"""A finished comparison, with its input files: recorded so that a report can name them and repeat it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pcbench.geometry.datums import StatedSystem
from pcbench.measure.results import Candidate, Difference, ReferenceSummary, Tiling
from pcbench.measure.settings import Settings
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.report.viewing import SceneFolder, ViewingCameras


@dataclass(frozen=True)
class InputFile:
    """An input file.

    Attributes:
        path: its path as given.
        sha256: its digest (`pcbench.io.source.Source.digest`).
        warnings: warnings of its reader.
        system: the coordinate system, units and datums that it states; None for a file that is no cloud.
    """

    path: str
    sha256: str
    warnings: tuple[str, ...] = ()
    system: StatedSystem | None = None


@dataclass(frozen=True)
class Inputs:
    """The input files of a comparison.

    Attributes:
        reference: the reference.
        candidates: the candidates by name.
        files: files named in settings, such as a matrix.
        scene: the scene whose cameras select the views, if its folder was given.
        tiling: settings of a tiled comparison; None: it was computed in memory.
    """

    reference: InputFile
    candidates: Mapping[str, InputFile] = field(default_factory=dict)
    files: tuple[InputFile, ...] = ()
    scene: SceneFolder | None = None
    tiling: TilingSettings | None = None

    def all_files(self) -> tuple[InputFile, ...]:
        """Return all input files."""
        return (self.reference, *self.candidates.values(), *self.files)

    def paths(self) -> list[Path]:
        """Return the paths of all input files, and of the scene."""
        return [*(Path(file.path) for file in self.all_files()), *([] if self.scene is None else self.scene.paths())]


@dataclass(frozen=True, eq=False, repr=False)
class FinishedComparison:
    """A reference, its candidates, and the differences between them; `comparison["a"]` is the candidate named a.

    Attributes:
        settings: the settings.
        reference: the reference.
        candidates: the candidates with all their results.
        differences: differences between candidates.
        tiling: how the comparison was computed in tiles; None: in memory.
        inputs: the input files; None if a cloud came from memory.
        cameras: the cameras of the scene, which select the views; None if unknown.
        has_map_files: whether the folder `maps` of the report has the deviation maps of all points.
    """

    settings: Settings
    reference: ReferenceSummary
    candidates: tuple[Candidate, ...]
    differences: tuple[Difference, ...] = ()
    tiling: Tiling | None = None
    inputs: Inputs | None = None
    cameras: ViewingCameras | None = None
    has_map_files: bool = False

    def __getitem__(self, name: str) -> Candidate:
        """Return the candidate of that name.

        Raises:
            KeyError: no candidate has that name.
        """
        for candidate in self.candidates:
            if candidate.name == name:
                return candidate
        raise KeyError(f"no candidate {name!r}: there are {', '.join(c.name for c in self.candidates)}")

    def __contains__(self, name: object) -> bool:
        """Return whether a candidate has that name."""
        return any(candidate.name == name for candidate in self.candidates)

    def __iter__(self) -> Iterator[Candidate]:
        return iter(self.candidates)

    def __len__(self) -> int:
        return len(self.candidates)
