"""Descriptions of the ladders, scenes, photographs and methods of a study; their fields are keys of stress.json."""

from __future__ import annotations

from dataclasses import dataclass

_SINGULAR_UNITS = {"spacings": "spacing", "copies": "copy", "stops": "stop"}


@dataclass(frozen=True)
class LadderInfo:
    """Description of a ladder: what it perturbs, from nothing to certain failure.

    Attributes:
        name: identifier, in lower case with hyphens.
        title: what is perturbed, for charts and tables, such as `rotation of the start`.
        kind: group of ladders: `start`, `noise`, `parts`, `density`, `coordinates`, `warp`, `changes` or `degenerate`;
            of photographs `unperturbed`, `images`, `cameras` or `surface`.
        subjects: names of the subjects that it is run for.
        unit: unit of the levels, such as `deg` or `%`; empty for plain numbers.
        levels: levels of the run, ascending in severity.
        level_names: names of the levels of a ladder that is a list of cases; otherwise empty.
        second_title: title of the second coordinate of a map; empty for a ladder.
        second_unit: unit of the second coordinate.
        second_levels: levels of the second coordinate of a map; empty for a ladder.
    """

    name: str
    title: str
    kind: str
    subjects: tuple[str, ...]
    unit: str
    levels: tuple[float, ...]
    level_names: tuple[str, ...] = ()
    second_title: str = ""
    second_unit: str = ""
    second_levels: tuple[float, ...] = ()

    @property
    def is_map(self) -> bool:
        """Return whether its cells have two coordinates."""
        return bool(self.second_levels)

    @property
    def is_list(self) -> bool:
        """Return whether its levels are cases without an order."""
        return bool(self.level_names)

    def level_text(self, level: float) -> str:
        """Return a level with its unit, or its name."""
        if self.level_names:
            return self.level_names[self.levels.index(level)]
        unit = _SINGULAR_UNITS.get(self.unit, self.unit) if level == 1 else self.unit
        return f"{level:g} {unit}".rstrip()


@dataclass(frozen=True)
class SceneInfo:
    """A scene of the study, in the unit of its clouds.

    Attributes:
        name: name of the scene.
        extent: side of the cube that holds the middle 98 % of the reference.
        spacing: median spacing of the reference.
        noise: standard deviation of each cloud's noise along the normals; None if unknown.
        unit: unit of lengths; empty if unknown.
        points: numbers of points of the reference and the candidate.
    """

    name: str
    extent: float
    spacing: float
    noise: float | None
    unit: str
    points: tuple[int, int]


@dataclass(frozen=True)
class PhotographInfo:
    """The photographs of a study of reconstructors, and how clouds are measured.

    Attributes:
        images: number of images.
        size: width and height of the images, in pixels.
        rig: arrangement of the cameras, of `pcbench synth city --rig`.
        extent: side of the city, in metres.
        pixel: median size of a pixel on the surface, in metres.
        threshold: distance threshold of precision, recall and F-score, in metres.
        surface_points: number of points that represent the true surface.
    """

    images: int
    size: tuple[int, int]
    rig: str
    extent: float
    pixel: float
    threshold: float
    surface_points: int


@dataclass(frozen=True)
class MethodInfo:
    """A method of the study.

    Attributes:
        name: name in cells, tables and charts.
        subject: name of the subject that it answers.
        scope: for a registration, `local` or `global`; otherwise empty.
        library: library that it comes from; `pcbench` for our own.
        version: version of that library.
    """

    name: str
    subject: str
    scope: str
    library: str
    version: str

    @property
    def is_ours(self) -> bool:
        """Return whether the method is pcbench's own."""
        return self.library == "pcbench"


@dataclass(frozen=True)
class MissingMethod:
    """A method that was left out, and the reason in one line."""

    name: str
    reason: str


def axis_title(title: str, unit: str) -> str:
    """Return a quantity with its unit in brackets, if it has one."""
    return f"{title} [{unit}]" if unit else title
