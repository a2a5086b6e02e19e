"""Subjects of the study: the cells and outcomes of their runs, and the methods that answer.

Registrations, metrics, verdicts and changes are subjects of pairs of clouds, reconstructions one of perturbed
photographs. Each has a module with its cells, its judge and one object, over which tables, charts and words iterate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from importlib.util import find_spec
from typing import Any, Generic, NamedTuple, TypeVar

from pcbench.extras import LIBRARIES, installed_versions
from pcbench.studies.stress.descriptions import MethodInfo, MissingMethod
from pcbench.studies.stress.scenes import StressPair

# Outcomes of a run. Every subject uses the first and the last two.
RIGHT = "right"
FALSE_ALARM = "false-alarm"  # the pose is right, but the result is doubtful
REFUSED = "refused"  # no pose, although another method found it from the same clouds
SAID = "said"  # wrong, and the result is doubtful; or no pose where none was findable
SILENT = "silent"  # wrong but not doubted
WRONG = "wrong"  # a verdict that contradicts the truth, or a change of another kind or at another place
WITHHELD = "withheld"  # no verdict
UNNAMED = "unnamed"  # a change that is not reported
WARNED = "warned"  # a poor cloud, and the reconstructor warns
DEGRADED = "degraded"  # a poor cloud without a warning
CRASH = "crash"
TIME_OUT = "time-out"

_GREEN, _BLUE, _RED, _BLACK = "#009e73", "#56b4e9", "#d55e00", "#333333"
_COLORS = {
    RIGHT: _GREEN,
    FALSE_ALARM: "#9fd9c4",
    REFUSED: "#f0e442",
    SAID: _BLUE,
    WITHHELD: _BLUE,
    WARNED: _BLUE,
    SILENT: _RED,
    WRONG: _RED,
    UNNAMED: "#e69f00",
    DEGRADED: _RED,
    CRASH: _BLACK,
    TIME_OUT: "#999999",
}

# Scopes of a registration method.
LOCAL = "local"  # starts from the given pose
GLOBAL = "global"  # needs no initial pose

COST_LEGEND = "CPU s: median; MiB: largest peak beyond the loaded clouds"


class Group(Enum):
    """Groups of the outcomes of all subjects."""

    SUCCESS = auto()
    SAID_SO = auto()
    CONFIDENT = auto()  # wrong without doubt
    ABORTED = auto()


class Outcome(NamedTuple):
    """A way in which a run can end: its name in cells and tables, its meaning in charts, and its group."""

    name: str
    label: str
    group: Group

    @property
    def color(self) -> str:
        """Colour in charts."""
        return _COLORS[self.name]

    @property
    def text_color(self) -> str:
        """Colour of text on its colour."""
        return "white" if self.color in (_GREEN, _RED, _BLACK) else "black"


ENDS = (Outcome(CRASH, "crash", Group.ABORTED), Outcome(TIME_OUT, "time-out", Group.ABORTED))


@dataclass(frozen=True)
class StressCell:
    """One run, and what it cost; the cells of each subject add its result.

    Attributes:
        scene: name of the scene.
        ladder: name of the ladder.
        level: level of the ladder.
        second: second coordinate, if the ladder is a map.
        method: name of the method.
        seed: seed of the run.
        outcome: outcome, of those of the subject.
        codes: codes of all warnings.
        message: reason of a refusal or a crash, in one line; otherwise empty.
        cpu_s: CPU seconds; None after a crash or a time-out.
        memory_bytes: peak of the memory of the run beyond that of the loaded clouds; None if unknown.
    """

    scene: str
    ladder: str
    level: float
    second: float | None
    method: str
    seed: int
    outcome: str
    codes: tuple[str, ...] = ()
    message: str = ""
    cpu_s: float | None = None
    memory_bytes: int | None = None

    @property
    def place(self) -> tuple[str, str, float, float | None, int]:
        """Scene, ladder, level, second coordinate and seed: the same for all methods."""
        return (self.scene, self.ladder, self.level, self.second, self.seed)

    @property
    def covers(self) -> bool | None:
        """Return whether its interval contains the truth; None without an interval that has to."""
        return None


C = TypeVar("C", bound=StressCell)
F = TypeVar("F")  # type of the function of a method


@dataclass(frozen=True)
class StressMethod(Generic[F]):
    """A method of the study.

    Attributes:
        name: name in cells, tables and charts.
        run: its function, as its subject calls it.
        library: library that it comes from.
        modules: modules that it needs; none for code of pcbench.
        scope: for a registration, `local` or `global`.
        is_quick: whether it is fast enough for the quick plan.
    """

    name: str
    run: F
    library: str = "pcbench"
    modules: tuple[str, ...] = ()
    scope: str = ""
    is_quick: bool = True

    def info(self, subject: str) -> MethodInfo:
        """Return the description for results."""
        package = self.library if self.modules else "pcbench"  # naive rules are code of pcbench
        version = installed_versions([package]).get(package, "")
        return MethodInfo(self.name, subject, self.scope, self.library, version)

    def missing(self) -> MissingMethod | None:
        """Return the first of its modules that is not installed as a reason, or None if the method can run."""
        for module in self.modules:
            if find_spec(module) is None:
                library = LIBRARIES[module]
                install = f"'pcbench[{library.extra}]'" if library.extra else library.name
                return MissingMethod(self.name, f"{library.name} is not installed: pip install {install}")
        return None


def by_name(*methods: StressMethod[F]) -> dict[str, StressMethod[F]]:
    """Return methods by their names."""
    return {method.name: method for method in methods}


@dataclass(frozen=True, eq=False)
class Subject(Generic[C]):
    """A subject of the study, and how its results are shown.

    Attributes:
        name: name in results and tables.
        title: title of its section.
        noun: what one of its cells is, in words.
        key: key of its cells in stress.json.
        cell: type of its cells.
        outcomes: outcomes of its runs in the order of bars and tables, from good to bad.
        legend: meaning of the outcomes and of the costs, below tables.
        success: what a successful run gives, for axes.
        charts: starts of the names of its charts, in the order of the article.
        row: function that returns the row of a cell in tables and charts.
    """

    name: str
    title: str
    noun: str
    key: str
    cell: type[C]
    outcomes: tuple[Outcome, ...]
    legend: str
    success: str
    charts: tuple[str, ...]
    row: Callable[[C], str] = lambda cell: cell.method

    def named(self, *groups: Group) -> tuple[str, ...]:
        """Return the names of the outcomes of groups."""
        return tuple(outcome.name for outcome in self.outcomes if outcome.group in groups)


@dataclass(frozen=True)
class RunResult:
    """Cells of a run, and for a registration its pose as a 4x4 matrix."""

    cells: tuple[StressCell, ...]
    pose: list[list[float]] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PairSubject(Subject[C]):
    """A subject of pairs of clouds, which methods answer.

    Attributes:
        methods: methods by name, the one that is ours first.
        ask: function of the name of a method, a pair and a seed that returns the answer of the method.
        judge: function of the answer, the pair and the values of `StressCell` that compares the answer with the truth.
        warm_up: function of a pair that imports what our own methods import in functions.
        needs_scene: whether the truth is more than a pose, so that a given pair has none.
        start: start of ladders that set none, as an angle in degrees and an offset over the extent; None: the true
            pose.
        is_joint: whether one run gives the cells of all methods.
        cells_of: function that returns the values that tell apart the cells of a run of a method.
        settle: function that returns all cells of a study with their final outcomes.
    """

    methods: Mapping[str, StressMethod[Any]]
    ask: Callable[[str, StressPair, int], Any]
    judge: Callable[[Any, StressPair, Mapping[str, Any]], RunResult]
    warm_up: Callable[[StressPair], object]
    needs_scene: bool = True
    start: tuple[float, float] | None = None
    is_joint: bool = False
    cells_of: Callable[[str], Iterable[Mapping[str, str]]] = lambda method: [{"method": method}]
    settle: Callable[[Sequence[C]], Sequence[C]] = lambda cells: cells

    def chosen(self, names: Sequence[str], *, quick: bool) -> list[StressMethod[Any]]:
        """Return the methods with given names; without any names, all of them or those of the quick plan."""
        if not names:
            return [method for method in self.methods.values() if method.is_quick or not quick]
        chosen = [method for method in self.methods.values() if method.name in names]
        return list(self.methods.values()) if chosen and self.is_joint else chosen
