"""Match camera names to images. Camera files often contain paths from another machine."""

from __future__ import annotations

from collections.abc import Iterable


class ImageNames:
    """Finds the image of a scene for a name in a camera file.

    This is the image with exactly this name. If there is none, it is the only image that shares the longest trailing
    part of the path, with or without extension. Backslashes separate folders too.
    """

    def __init__(self, images: Iterable[str]) -> None:
        self._images: dict[str, str | None] = {}  # None if several images share the key
        names = list(images)
        for name in names:
            for key in {end for path in (name, _without_extension(name)) for end in _trailing_paths(path)} - {name}:
                self._images[key] = None if key in self._images else name
        self._images |= {name: name for name in names}

    def __call__(self, camera: str) -> str | None:
        """Return the image's name, or None if no image or several images match."""
        if camera in self._images:
            return self._images[camera]
        path = camera.replace("\\", "/")
        for end in _trailing_paths(path):
            for key in (end, _without_extension(end)):
                if image := self._images.get(key):
                    return image
        return None


def _trailing_paths(path: str) -> list[str]:
    """Return the trailing parts of a path: a/b/c, b/c and c."""
    parts = [part for part in path.split("/") if part not in ("", ".")]
    return ["/".join(parts[k:]) for k in range(len(parts))]


def _without_extension(path: str) -> str:
    """Return a path without the extension of its last part."""
    folder, slash, name = path.rpartition("/")
    stem, dot, _ = name.rpartition(".")
    return folder + slash + (stem if dot and stem else name)
