"""Common parts of all protocols: inputs, settings with the official defaults, and the numbers that they print."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

from pcbench.errors import InputError, did_you_mean
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.regions import Region
from pcbench.geometry.transform import Similarity

Better = Literal["lower", "higher"]
Shape = Path | Cloud | Mesh
"""A file, or a shape in memory."""


class ProtocolScore(NamedTuple):
    """One number that a protocol prints.

    Attributes:
        name: its name, with its threshold if it has one, such as `f1@0.02`.
        value: its value; None: it is undefined for this pair.
        unit: its unit, such as `mm`; empty: a share, or a number without unit.
        better: whether lower or higher values are better; None: it is a count or a description.
    """

    name: str
    value: float | None
    unit: str = ""
    better: Better | None = "lower"


@dataclass(frozen=True)
class Evaluation:
    """Result of a protocol for one candidate.

    Attributes:
        protocol: text of the protocol with the settings that differ from its defaults, such as `dtu:thinning=0.5`.
        scores: the numbers that papers quote, in their order.
        counts: numbers of points and other intermediate values that tell whether the evaluation went as intended.
        notes: what a reader of the scores has to know, such as that a mesh was sampled.
        failed_metrics: names of user-defined metrics that failed; notes say why.
    """

    protocol: str
    scores: tuple[ProtocolScore, ...]
    counts: tuple[ProtocolScore, ...] = ()
    notes: tuple[str, ...] = ()
    failed_metrics: tuple[str, ...] = ()


def _ignore(_: str) -> None:
    """Ignore a step."""


@dataclass(frozen=True, eq=False)
class EvaluationInputs:
    """Inputs of an evaluation.

    Attributes:
        reference: ground truth: a file that the protocol can read, or a shape in memory.
        candidate: the reconstruction, in its own coordinates.
        scene: name of the scene, from which a protocol finds its files in `data`.
        data: folder with files of the benchmark, such as masks; None: there is none.
        pose: pose candidate -> reference; None: the candidate is in the coordinates of the reference.
        crop: region to which the evaluation is limited, in the reference's coordinates, if the protocol supports one.
        seed: seed of random samples and orders.
        metrics: user-defined metrics as on the command line, see `pcbench.measure.own_metrics`.
        on_step: called with a short text before each step that takes time.
    """

    reference: Shape
    candidate: Shape
    scene: str = ""
    data: Path | None = None
    pose: Similarity | None = None
    crop: Region | None = None
    seed: int = 0
    metrics: tuple[str, ...] = ()
    on_step: Callable[[str], None] = field(default=_ignore)


@runtime_checkable
class BenchmarkProtocol(Protocol):
    """A protocol: a frozen dataclass whose fields are its settings, with the official values as defaults.

    Attributes:
        name: its name on the command line.
        title: name of the benchmark, for people.
        citation: paper that defines it.
        version: official program whose numbers it reproduces, with its date.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    citation: ClassVar[str]
    version: ClassVar[str]

    def evaluate(self, inputs: EvaluationInputs) -> Evaluation:
        """Evaluate a candidate.

        Raises:
            InputError: a file is missing or unusable; the message names it, and says what to do.
        """
        ...

    def other_files(self, inputs: EvaluationInputs) -> tuple[Path, ...]:
        """Return the files and folders that the scores depend on, besides the reference, the candidate and a crop.

        They need not exist. Scores are evaluated again if one of them changes.

        Raises:
            InputError: a file is missing that the evaluation needs.
        """
        ...


def setting_texts(protocol: BenchmarkProtocol) -> dict[str, str]:
    """Return the settings of a protocol that differ from the official ones, by name."""
    changed = {item.name: getattr(protocol, item.name) for item in fields(protocol)}  # type: ignore[arg-type]
    official = type(protocol)()
    return {name: _text(value) for name, value in changed.items() if value != getattr(official, name)}


def protocol_text(protocol: BenchmarkProtocol) -> str:
    """Return the protocol as on the command line, such as `dtu:thinning=0.5,max_distance=10`."""
    settings = ",".join(f"{name}={text}" for name, text in setting_texts(protocol).items())
    return f"{protocol.name}:{settings}" if settings else protocol.name


def parse_settings(kind: type[BenchmarkProtocol], text: str) -> BenchmarkProtocol:
    """Return a protocol with the settings of a text such as `thinning=0.5,max_distance=10`; empty: the official ones.

    A value has the type of the official one; a tuple of numbers is written with `/`, such as `tolerances=0.01/0.02`.

    Raises:
        InputError: a name is unknown or repeated, or a value is invalid.
    """
    official = {item.name: item.default for item in fields(kind)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for part in text.split(",") if text else ():
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or name not in official:
            known_names = ", ".join(official) or "none"
            hint = did_you_mean(name, official)
            raise InputError(
                f"{kind.name}: expected NAME=VALUE with a name of {known_names}; got {part.strip()!r}{hint}"
            )
        if name in values:
            raise InputError(f"{kind.name}: expected {name} once, got it twice")
        values[name] = _parse(kind.name, name, value, official[name])
    return kind(**values)


def _parse(protocol: str, name: str, text: str, official: Any) -> Any:
    if isinstance(official, str):
        return text
    if isinstance(official, bool):
        if text.lower() not in ("true", "false"):
            raise InputError(f"{protocol}: expected {name} as true or false, got {text!r}")
        return text.lower() == "true"
    kind = int if isinstance(official, int) else float
    try:
        return tuple(float(word) for word in text.split("/")) if isinstance(official, tuple) else kind(text)
    except ValueError:
        expected = "numbers such as 0.01/0.02" if isinstance(official, tuple) else f"a number such as {official}"
        raise InputError(f"{protocol}: expected {name} as {expected}, got {text!r}") from None


def _text(value: Any) -> str:
    return (
        "/".join(map(str, value))
        if isinstance(value, tuple)
        else str(value).lower()
        if isinstance(value, bool)
        else str(value)
    )
