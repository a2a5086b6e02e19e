"""Which image a camera's name means: files name images by ways that were right on another machine."""

from __future__ import annotations

from collections.abc import Iterable


class ImageNames:
    """A scene's images by name: the same name, else the only image that ends in as much of the way as any does, with
    or without its extension. Backslashes part folders too.
    """

    def __init__(self, images: Iterable[str]) -> None:
        self._images: dict[str, str | None] = {}  # None where several images end so
        names = list(images)
        for name in names:
            for key in {end for path in (name, _without_extension(name)) for end in _trailing_paths(path)} - {name}:
                self._images[key] = None if key in self._images else name
        self._images |= {name: name for name in names}

    def __call__(self, camera: str) -> str | None:
        """The image's name; None where there is none, or more than one that it could be."""
        if camera in self._images:
            return self._images[camera]
        path = camera.replace("\\", "/")
        for end in _trailing_paths(path):
            for key in (end, _without_extension(end)):
                if found := self._images.get(key):
                    return found
        return None


def _trailing_paths(path: str) -> list[str]:
    """a/b/c, b/c and c."""
    parts = [part for part in path.split("/") if part not in ("", ".")]
    return ["/".join(parts[k:]) for k in range(len(parts))]


def _without_extension(path: str) -> str:
    """Without the extension of its last part."""
    folder, slash, name = path.rpartition("/")
    stem, dot, _ = name.rpartition(".")
    return folder + slash + (stem if dot and stem else name)
