"""The input files of a comparison, recorded so that a report can name them and repeat it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pcbench.measure import results
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.report.viewing import ViewingCameras


@dataclass(frozen=True)
class InputFile:
    """An input file: its path as given, its digest (`pcbench.io.contents.cloud_digest`), and warnings of its reader."""

    path: str
    sha256: str
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class SceneFolder:
    """The folder of a scene and where its cameras are: `auto` (found in it), or a file or folder."""

    path: Path
    cameras: str = "auto"

    def absolute(self) -> SceneFolder:
        """Return the scene with absolute paths."""
        cameras = self.cameras if self.cameras == "auto" else str(Path(self.cameras).absolute())
        return SceneFolder(self.path.absolute(), cameras)

    def paths(self) -> list[Path]:
        """Return the folder, and the file or folder of the cameras if it is named."""
        return [self.path, *([] if self.cameras == "auto" else [Path(self.cameras)])]


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
class SourcedComparison(results.CandidateComparisons):
    """A measured comparison with its input files, from which all outputs are written.

    Attributes:
        inputs: the files; None if a cloud came from memory.
        cameras: the cameras of the scene, which select the views; None if unknown.
        has_map_files: whether the folder `maps` of the report has the deviation maps of all points.
    """

    inputs: Inputs | None = None
    cameras: ViewingCameras | None = None
    has_map_files: bool = False
