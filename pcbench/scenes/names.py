"""Which image a camera's name means: files name images by ways that were right on another machine."""

from __future__ import annotations

from collections.abc import Iterable


class ImageNames:
    """A scene's images by name: the same name, else the only image that ends in as much of the way as any does, with
    or without its extension. Backslashes part folders too.
    """

    def __init__(self, images: Iterable[str]) -> None:
        self._found: dict[str, str | None] = {}  # None where several images end so
        names = list(images)
        for name in names:
            for key in {end for way in (name, _bare(name)) for end in _ends(way)} - {name}:
                self._found[key] = None if key in self._found else name
        self._found |= {name: name for name in names}

    def __call__(self, camera: str) -> str | None:
        """The image's name; None where there is none, or more than one that it could be."""
        if camera in self._found:
            return self._found[camera]
        way = camera.replace("\\", "/")
        for end in _ends(way):
            for key in (end, _bare(end)):
                if found := self._found.get(key):
                    return found
        return None


def _ends(way: str) -> list[str]:
    """a/b/c, b/c and c."""
    parts = [part for part in way.split("/") if part not in ("", ".")]
    return ["/".join(parts[k:]) for k in range(len(parts))]


def _bare(way: str) -> str:
    """Without the extension of its last part."""
    folder, slash, name = way.rpartition("/")
    stem, dot, _ = name.rpartition(".")
    return folder + slash + (stem if dot and stem else name)
