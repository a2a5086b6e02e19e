"""Photographs that EXIF turns for display: which of their two sizes the cameras are for."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera
from pcbench.scenes.decode import Size

# Counter-clockwise quarter turns from the displayed to the stored image, by EXIF orientation without a reflection.
_TURNS = {1: 0, 3: 2, 6: 1, 8: 3}
_SAVE_UPRIGHT = "save the photographs upright (mogrify -auto-orient FILES) and use their cameras"


class StoredCamera(NamedTuple):
    """Camera of the stored pixels of a photograph.

    `was_turned` says whether it was given for the displayed photograph, `is_ambiguous` whether the sizes cannot tell.
    """

    camera: Camera
    was_turned: bool = False
    is_ambiguous: bool = False


def camera_of_stored(camera: Camera, size: Size, orientation: int, source: Path) -> StoredCamera:
    """Return the camera of the stored pixels of a photograph, whether it was given for these or as displayed.

    The aspect ratio of the camera decides. If it fits both, the camera is taken as that of the stored pixels, on which
    COLMAP works.

    Args:
        camera: camera as given.
        size: stored size (width, height) of the photograph, in pixels.
        orientation: EXIF orientation of the photograph, 1 to 8.
        source: file or folder of the cameras, for messages.

    Raises:
        InputError: the camera fits neither, or a reflection. The message does not name the photograph.
    """
    camera_size = camera.intrinsics.width, camera.intrinsics.height
    fits_stored, fits_turned = _same_aspect(camera_size, size), _same_aspect(camera_size, (size[1], size[0]))
    if fits_stored:
        return StoredCamera(camera, is_ambiguous=orientation in (2, 3, 4) or (orientation > 4 and fits_turned))
    expected = (
        f"expected an image of {camera_size[0]} x {camera_size[1]} pixels as its camera in {source}, got"
        f" {size[0]} x {size[1]}"
    )
    if not fits_turned:
        raise InputError(f"{expected}: use the images of these cameras")
    if orientation <= 4:
        raise InputError(
            f"{expected}, turned by 90 degrees: turn the photographs back (mogrify -rotate 90 FILES, or -90), or use"
            " the cameras of the turned ones"
        )
    if orientation not in _TURNS:
        raise InputError(f"{expected}, mirrored and turned by EXIF (orientation {orientation}): {_SAVE_UPRIGHT}")
    for _ in range(_TURNS[orientation]):
        camera = camera.turned()
    return StoredCamera(camera, was_turned=True)


def _same_aspect(camera: Size, image: Size) -> bool:
    """Return whether two sizes have the same aspect ratio, up to rounding by one pixel in either size."""
    scale = image[0] / camera[0]
    return abs(camera[1] * scale - image[1]) <= 1 + scale


def describe_turned(turned: list[str], ambiguous: list[str], total: int) -> list[str]:
    """Return warnings on photographs with cameras of their displayed pixels, and on those whose sizes cannot tell."""
    lines = []
    if turned:
        lines.append(
            f"{len(turned)} of {total} cameras are of photographs as EXIF turns them, such as {turned[0]}: turned these"
            " cameras to the stored pixels"
        )
    if ambiguous:
        lines.append(
            f"EXIF turns or mirrors {len(ambiguous)} of {total} photographs, such as {ambiguous[0]}, and their sizes do"
            f" not show whether the cameras are of the turned ones: took them as of the stored pixels; if not,"
            f" {_SAVE_UPRIGHT}"
        )
    return lines
