"""Parse the text files of COLMAP models: lines, counts, and the images. Format: colmap.github.io/format.html."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from pcbench.errors import InputError
from pcbench.io.files import Warn

_POSE_WORDS = 9  # id, qw qx qy qz, tx ty tz, camera; then the name, which may contain spaces
_KEYPOINT_BYTES = b"0123456789+-.eEnaifNIF \t"  # of numbers, also nan and inf
_MAX_EXCERPT = 60  # characters of a line in messages


class ImagePose(NamedTuple):
    """First line of an image: its name, camera ID, and pose (qw, qx, qy, qz, tx, ty, tz)."""

    name: str
    camera: int
    pose: tuple[float, ...]


def data_lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the number, from 1, and the text of each line that is not a comment; blank lines are empty.

    Only line feeds and carriage returns end a line: names may contain other separators of Unicode.
    """
    for number, line in enumerate(data.removeprefix(b"\xef\xbb\xbf").splitlines(), 1):
        text = line.strip()
        if not text.startswith(b"#"):
            yield number, text


def excerpt(line: bytes) -> str:
    """Return the start of a line for a message."""
    return repr(line.decode(errors="replace")[:_MAX_EXCERPT])


def check_complete(data: bytes, kind: str, count: int, warn: Warn, *, ends_early: bool = False) -> None:
    """Check that a text file holds all items that its header states; without such a header, that its end is complete.

    Args:
        data: the file.
        kind: what it lists, as in COLMAP's comment: cameras, images or points.
        count: number of items read.
        warn: callback, called with one line if the file may have been cut off.
        ends_early: whether the last item lacks a line that others have.

    Raises:
        InputError: the file holds fewer items than its header states.
    """
    declared = _declared_count(data, kind)
    if declared is not None and count < declared:
        raise InputError(
            f"truncated: its header states {declared} {kind}, got {count}: copy or export the model again, or correct"
            " the header if you removed some"
        )
    if declared is None and count and (ends_early or not data.endswith((b"\n", b"\r"))):
        where = "before the second line of its last image" if ends_early else "without a line break"
        warn(f"the file ends {where} and may be cut off: read {count} {kind}, check that none is missing")


def count_items(data: bytes, kind: str) -> int:
    """Return the number of images or points of a text file, as its header states or of its lines.

    Raises:
        InputError: the images cannot be parsed.
    """
    declared = _declared_count(data, kind)
    if declared is not None:
        return declared
    if kind == "images":
        return len(parse_images(data, lambda _: None))
    return sum(bool(line) for _, line in data_lines(data))


def _declared_count(data: bytes, kind: str) -> int | None:
    """Return the count in COLMAP's comment line, such as `# Number of points: 7, mean track length: 3`."""
    stated = re.search(rb"^#\s*Number of " + kind.encode() + rb":\s*(\d{1,18})\b", data[:4096], re.MULTILINE)
    return int(stated[1]) if stated else None


def parse_images(data: bytes, warn: Warn) -> list[ImagePose]:
    """Parse an images.txt: each image has a line of id, quaternion, translation, camera and name, and one of keypoints.

    The second line holds (x, y, point) triples. It may be empty, or absent, as some programs and editors write it: each
    line is recognised by its content.

    Raises:
        InputError: a line is neither of them, or the file is cut off.
    """
    images: list[ImagePose] = []
    with_second_line: set[int] = set()  # counts of images so far
    awaits_keypoints = after_blank = False
    for number, line in data_lines(data):
        if not line:
            with_second_line.add(len(images))
            after_blank = True
        elif awaits_keypoints and _is_keypoints(line) and not (after_blank and _parse_pose(line)):
            with_second_line.add(len(images))
            awaits_keypoints = False
        else:
            image = _parse_pose(line)
            if image is None:
                expected = "id, qw qx qy qz, tx ty tz, camera, name"
                if awaits_keypoints:
                    expected = f"(x, y, point) triples of image {images[-1].name!r}, or the next image as {expected}"
                raise InputError(
                    f"line {number}: expected {expected}; got {excerpt(line)}: copy or export the model again"
                )
            images.append(image)
            awaits_keypoints, after_blank = True, False
    ends_early = len(images) not in with_second_line and bool(with_second_line - {0})
    check_complete(data, "images", len(images), warn, ends_early=ends_early)
    return images


def _parse_pose(line: bytes) -> ImagePose | None:
    """Parse the first line of an image; return None if it is another line."""
    words = line.split(maxsplit=_POSE_WORDS)
    try:
        number, camera = int(words[0]), int(words[8])
        pose = tuple(float(word) for word in words[1:8])
        name = words[9].decode()
    except (ValueError, IndexError):
        return None
    return ImagePose(name, camera, pose) if number >= 0 and camera >= 0 else None


def _is_keypoints(line: bytes) -> bool:
    """Return whether a line holds triples of x, y and the ID of a point, -1 for none."""
    if line.translate(None, _KEYPOINT_BYTES):
        return False
    words = line.split()
    try:
        return len(words) % 3 == 0 and all(int(word) >= -1 for word in words[2::3])
    except ValueError:
        return False
