"""Files of Tanks and Temples (Knapitsch et al. 2017), as its evaluation data are downloaded.

The folder of a scene such as `Barn` has

- `Barn.ply`: the laser scan,
- `Barn.json`: the volume to which both clouds are cropped,
- `Barn_COLMAP_SfM.log`: camera poses of a reconstruction, one for each image,
- `Barn_trans.txt`: the transform from that reconstruction to the scan,
- `Barn_mapping_reference.txt` (optional): the frames of the video that the images are.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import IntArray
from pcbench.geometry.polygon_files import read_polygon
from pcbench.geometry.regions import Region
from pcbench.geometry.transform import Similarity, read_matrix
from pcbench.io.files import Warn, errors_named
from pcbench.io.trajectory import Trajectory, read_trajectory
from pcbench.regular_files import read_text

_ENDINGS = (".ply", ".json", "_trans.txt", "_COLMAP_SfM.log", "_mapping_reference.txt")

SCENE_THRESHOLDS = {
    "Barn": 0.01,
    "Caterpillar": 0.005,
    "Church": 0.025,
    "Courthouse": 0.025,
    "Ignatius": 0.003,
    "Meetingroom": 0.01,
    "Truck": 0.005,
}
"""Distance thresholds of the official evaluation by scene, in metres."""


@dataclass(frozen=True)
class TntScene:
    """The files of one scene; each is read when it is asked for.

    Attributes:
        folder: folder that has them.
        name: name of the scene, with which their names begin.
    """

    folder: Path
    name: str

    @classmethod
    def find(cls, folders: Iterable[Path], name: str) -> TntScene:
        """Return the scene in the first folder, or subfolder with the scene's name, that has one of its files.

        Raises:
            InputError: no folder has one.
        """
        places = [place for folder in folders for place in (folder / name, folder)]
        for place in places:
            scene = cls(place, name)
            if any(scene.path(ending).is_file() for ending in (".json", "_trans.txt", "_COLMAP_SfM.log")):
                return scene
        looked_in = ", ".join(dict.fromkeys(map(str, places))) or "no folder"
        raise InputError(
            f"expected the files of the scene {name!r} of Tanks and Temples, such as {name}.json, got none in"
            f" {looked_in}: name the folder of its evaluation data"
        )

    @classmethod
    def of_folder(cls, folder: Path) -> TntScene:
        """Return the scene of a folder that has its name, or that has one crop volume `NAME.json`.

        Raises:
            InputError: the folder has the files of no scene or of several.
        """
        name = folder.resolve().name
        if cls(folder, name).path(".json").is_file():
            return cls(folder, name)
        names = sorted(file.stem for file in folder.glob("*.json")) if folder.is_dir() else []
        if len(names) != 1:
            raise InputError(
                f"{folder}: expected the folder of one scene of Tanks and Temples with {name}.json, got"
                f" {len(names) or 'no'} .json file{'s' * (len(names) != 1)}"
            )
        return cls(folder, names[0])

    def path(self, ending: str) -> Path:
        """Return the path of the file with an ending such as `.json`."""
        return self.folder / f"{self.name}{ending}"

    def files(self) -> tuple[Path, ...]:
        """Return the paths of all files of the scene, of which some may not exist."""
        return tuple(map(self.path, _ENDINGS))

    @property
    def threshold(self) -> float:
        """Official distance threshold in metres; the error of another scene says what to do."""
        if self.name not in SCENE_THRESHOLDS:
            raise InputError(
                f"expected the threshold of the scene {self.name!r}, because Tanks and Temples defines those of"
                f" {', '.join(SCENE_THRESHOLDS)} only: give it, in metres"
            )
        return SCENE_THRESHOLDS[self.name]

    def crop_volume(self) -> Region:
        """Read the volume to which both clouds are cropped, in the scan's coordinates."""
        return read_polygon(self.path(".json"))

    def scan_from_sfm(self) -> Similarity:
        """Read the transform from the coordinates of the reference reconstruction to those of the scan."""
        return read_matrix(self.path("_trans.txt"))

    def trajectory(self, on_warning: Warn) -> Trajectory:
        """Read the camera centres of the reference reconstruction, in its own coordinates."""
        return read_trajectory(self.path("_COLMAP_SfM.log"), on_warning)

    def video_frames(self) -> IntArray | None:
        """Read the frame of the video, from 0, that each image is; None if there is no file.

        Raises:
            InputError: the file is malformed.
        """
        path = self.path("_mapping_reference.txt")
        if not path.is_file():
            return None
        with errors_named(path):
            try:
                count, _, *rows = [
                    [int(word) for word in line.split()] for line in read_text(path).splitlines() if line
                ]
                frames = np.array([frame for _, frame in rows], dtype=np.int64) - 1
            except (ValueError, OverflowError):
                raise InputError("expected two numbers, then lines with the numbers of an image and a frame") from None
            if count != [len(frames)] or not len(frames) or frames.min() < 0:
                raise InputError(
                    f"expected {count[0] if count else 'some'} lines with frames from 1, got {len(frames)}"
                )
        return frames
