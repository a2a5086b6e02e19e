"""The cameras that photographed the clouds: which way is up in the pictures, and from which side they are seen."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from pcbench.errors import InputError, describe_damage
from pcbench.geometry.arrays import FloatArray, as_rows, even_rows, random_rows
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.transform import Similarity
from pcbench.geometry.upright import find_up, rotation_to_z
from pcbench.regular_files import read_json

if TYPE_CHECKING:
    from pcbench.scenes import Scene

SceneLike: TypeAlias = "Scene | str | os.PathLike[str]"
"""A scene, or the path of its folder."""
CAMERAS_FILE = "cameras.json"
SCHEMA = "pcbench.cameras/1"
_MAX_LEAN_DEG = 10.0  # between the up direction of the cameras and +z, if +z is up: twice its largest standard error
_MAX_LEVEL_DEG = 5.0  # RMS angle of the images' rows to the horizontal plane, if +z is up
_UPRIGHT_COSINE, _MIN_TOP_COSINE = 0.9, 0.3  # mean cosine of the upper sides of upright and of oblique images with +z
_MAX_OBLIQUE_DEG = 25.0  # between +z and the reversed view of a survey, if +z is up
_MIN_TOP_LENGTH = 0.5  # of the mean of the images' upper sides, as the last resort for up
_MIN_HORIZONTAL_SHARE = 0.3  # mean horizontal part of viewing directions that have a common heading
_FIELD_DEG = 60.0  # from the viewing direction: points beyond it are outside the image
_MAX_REACH = 100.0  # distance of a point from a camera, as a multiple of the sizes of the cloud and of the flight
_MAX_SEEN_SAMPLE = 2000  # points of a cloud, some of which some camera must see
_MAX_SEEING_CAMERAS = 500  # cameras for which this is checked


@dataclass(frozen=True, eq=False)
class ViewingCameras:
    """Cameras in the coordinates of a reference, for the viewpoints of pictures.

    Attributes:
        centers: (N, 3) centres of projection, N >= 1.
        directions: (N, 3) viewing directions, unit vectors.
        up: (3,) the upward direction, a unit vector; None if the cameras do not determine it.
        is_rotated: whether the frame is not that of the reference, so that its axes mean nothing to the user.
    """

    centers: FloatArray
    directions: FloatArray
    up: FloatArray | None
    is_rotated: bool = False

    @classmethod
    def of(cls, cameras: Collection[Camera], *, z_is_up: bool = False) -> ViewingCameras:
        """Return the centres and directions of cameras, with the upward direction that they show.

        Up is +z if that is known or consistent with the cameras. Otherwise it is found by
        `pcbench.geometry.upright.find_up`, or is the mean of the images' upper sides if those agree.

        Args:
            cameras: the cameras, at least one.
            z_is_up: whether +z is known to be up, as in a coordinate system.
        """
        rotations = np.stack([camera.cam_from_world.rotation for camera in cameras])
        centers = np.stack([camera.position for camera in cameras])
        up = np.array([0.0, 0.0, 1.0]) if z_is_up else _find_up(cameras, rotations)
        return cls(centers, rotations[:, 2], up)

    @property
    def axis_names(self) -> tuple[str, str, str]:
        """Names of the axes of the frame: those of the reference, or of what the cameras see after a rotation."""
        return ("right", "forward", "up") if self.is_rotated else ("x", "y", "z")

    def upright(self) -> tuple[Similarity | None, ViewingCameras]:
        """Return the rotation about the origin after which +z is up, and the rotated cameras; None if it is already."""
        if self.is_upright:
            return None, self
        rotation = Similarity(self.upright_rotation(), np.zeros(3))
        return rotation, self.rotated(rotation.rotation)

    def rotated(self, rotation: FloatArray) -> ViewingCameras:
        """Return the cameras after a rotation (3, 3) about the origin."""
        up = None if self.up is None else rotation @ self.up
        return ViewingCameras(self.centers @ rotation.T, self.directions @ rotation.T, up, is_rotated=True)

    def equals(self, other: ViewingCameras) -> bool:
        """Return whether other cameras are the same to the last bit."""
        ours, theirs = (np.vstack([cameras.centers, cameras.directions, up_of(cameras)]) for cameras in (self, other))
        return np.array_equal(ours, theirs) and (self.up is None) == (other.up is None)

    @property
    def is_upright(self) -> bool:
        """Return whether +z is up, or may be because up is unknown."""
        return self.up is None or bool(self.up[2] > 1 - 1e-12)  # after a rotation it is rounded

    def upright_rotation(self) -> FloatArray:
        """Return the rotation (3, 3) about the origin after which +z is up; the identity if it is, or if up is unknown.

        After it, the cameras look along +y on average. If they look in all directions, the first camera that does not
        look down does; if all look down, +x is the direction of the flight. So the result does not depend on the frame
        of the cameras.
        """
        if self.up is None or self.is_upright:
            return np.eye(3)
        level = rotation_to_z(self.up)
        forward = _heading(self.directions @ level.T, self.centers @ level.T)
        x, y = forward / np.linalg.norm(forward)
        return np.array([[y, -x, 0], [x, y, 0], [0, 0, 1.0]]) @ level

    def check_sight(self, points: FloatArray) -> None:
        """Check that some camera sees some of the points (N, 3) of a cloud.

        Raises:
            InputError: no camera does, so the cameras are not in the coordinates of the cloud.
        """
        sample = random_rows(points, _MAX_SEEN_SAMPLE)
        rows = even_rows(len(self.centers), _MAX_SEEING_CAMERAS)
        size = np.linalg.norm(np.ptp(sample, axis=0)) + np.linalg.norm(np.ptp(self.centers, axis=0))
        for center, direction in zip(self.centers[rows], self.directions[rows], strict=True):
            offsets = sample - center
            distances = np.linalg.norm(offsets, axis=1)
            in_field = offsets @ direction > np.cos(np.radians(_FIELD_DEG)) * distances
            if (in_field & (distances <= _MAX_REACH * max(float(size), 1e-12))).any():
                return
        raise InputError(
            "expected cameras in the coordinates of the cloud, got cameras that do not see it: transform them, or name"
            " others (--cameras)"
        )

    def write(self, path: Path) -> None:
        """Write the cameras as JSON with all digits.

        Raises:
            OSError: the file cannot be written.
        """
        up = None if self.up is None else self.up.tolist()
        values = {"schema": SCHEMA, "up": up, "centers": self.centers.tolist(), "directions": self.directions.tolist()}
        path.write_text(json.dumps(values) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> ViewingCameras:
        """Read the cameras that `write` wrote.

        Raises:
            InputError: the file is damaged.
            OSError: it cannot be read.
        """
        try:
            values: Any = read_json(path)
            if values["schema"] != SCHEMA:
                raise InputError(f"expected the schema {SCHEMA}, got {values['schema']!r}")
            centers, directions = (as_rows(name, values[name]) for name in ("centers", "directions"))
            up = None if values["up"] is None else as_rows("up", [values["up"]])
        except (InputError, LookupError, TypeError) as error:
            raise InputError(f"{path}: expected cameras written by pcbench: {describe_damage(error)}") from error
        vectors = directions if up is None else np.concatenate([directions, up])
        is_unit = np.abs(np.linalg.norm(vectors, axis=1) - 1) < 1e-6
        if not len(centers) or len(centers) != len(directions) or not np.isfinite(centers).all() or not is_unit.all():
            raise InputError(f"{path}: expected centres and unit viewing directions of the same cameras")
        return cls(centers, directions, None if up is None else up[0])


def up_of(cameras: ViewingCameras | None) -> FloatArray:
    """Return the upward direction (3,) of cameras; +z if it is unknown."""
    return np.array([0.0, 0.0, 1.0]) if cameras is None or cameras.up is None else cameras.up


def _find_up(cameras: Collection[Camera], rotations: FloatArray) -> FloatArray | None:
    """Return the upward direction (3,) of cameras with rotations (N, 3, 3), or None."""
    z = np.array([0.0, 0.0, 1.0])
    top = -rotations[:, 1].mean(axis=0)
    is_level = np.sqrt(np.mean(np.square(rotations[:, 0, 2]))) < np.sin(np.radians(_MAX_LEVEL_DEG))
    if is_level and top[2] > _UPRIGHT_COSINE:  # images of a facade, even if they all look in one direction
        return z
    up, _ = find_up(cameras)
    if up is not None:
        lean_deg = np.degrees(np.arccos(min(up[2], 1.0)))
        return z if lean_deg < (_MAX_OBLIQUE_DEG if is_level else _MAX_LEAN_DEG) else up
    if is_level and top[2] > _MIN_TOP_COSINE:  # oblique images that all look in one direction
        return z
    length = np.linalg.norm(top)
    return top / length if length > _MIN_TOP_LENGTH else None


def _heading(directions: FloatArray, centers: FloatArray) -> FloatArray:
    """Return the horizontal direction (2,) in which cameras look whose frame has +z up, see `upright_rotation`."""
    flat = directions[:, :2]
    mean: FloatArray = flat.mean(axis=0)
    if np.linalg.norm(mean) > _MIN_HORIZONTAL_SHARE:
        return mean
    lengths = np.linalg.norm(flat, axis=1)
    if lengths.mean() > _MIN_HORIZONTAL_SHARE:
        first: FloatArray = flat[int(np.argmax(lengths > _MIN_HORIZONTAL_SHARE))]
        return first
    steps = np.diff(centers[:, :2], axis=0)
    steps = steps[steps.any(axis=1)]
    if not len(steps):
        return np.array([0.0, 1.0])
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)  # the way to the next strip is long, but only one step
    along = np.linalg.eigh(steps.T @ steps)[1][:, 1]
    progress = steps @ along
    first_long = progress[np.argmax(np.abs(progress) > 0.5 * np.abs(progress).max())]
    across: FloatArray = np.sign(first_long) * np.array([-along[1], along[0]])
    return across


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


def as_scene(scene: SceneLike | SceneFolder) -> Scene | SceneFolder:
    """Return a scene, or its folder.

    Raises:
        InputError: the argument is neither.
    """
    if isinstance(scene, SceneFolder):
        return scene
    if isinstance(scene, str | os.PathLike):
        return SceneFolder(Path(scene))
    from pcbench.scenes import Scene

    if not isinstance(scene, Scene):
        raise InputError(f"expected a scene or the path of its folder, got {type(scene).__name__}")
    return scene


def viewing_cameras(
    scene: Scene | SceneFolder | ViewingCameras, shown: Cloud | Mesh, on_warning: Callable[[str], None]
) -> ViewingCameras:
    """Return the cameras of a scene for the views of a cloud or a mesh, read from its folder if necessary.

    Raises:
        InputError: the scene cannot be read, has no cameras, or none of them sees it.
    """
    if isinstance(scene, ViewingCameras):
        return scene
    if isinstance(scene, SceneFolder):
        from pcbench.scenes import read_scene

        scene = read_scene(scene.path, cameras=scene.cameras, on_warning=on_warning)
    if not scene.cameras:
        raise InputError(
            f"{scene.folder}: expected a scene with cameras, got none: name their file or folder (--cameras)"
        )
    z_is_up = shown.crs is not None or scene.origin is not None
    cameras = ViewingCameras.of(scene.cameras.values(), z_is_up=z_is_up)
    try:
        cameras.check_sight(shown.vertices if isinstance(shown, Mesh) else shown.points)
    except InputError as error:
        raise InputError(f"{scene.folder}: {error}") from error
    return cameras
