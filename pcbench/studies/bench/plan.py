"""What a bench runs: every method, at every budget, with every seed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from pcbench.errors import InputError
from pcbench.plugins.run import Description
from pcbench.studies.bench.pareto import choice_text

IMAGE_SCALE = "image_scale"  # of the scene; every other name is a setting of the method
_MAX_RUNS_PER_METHOD = 10_000  # of a method
_SEED_SETTING = "seed"


@dataclass(frozen=True)
class Axis:
    """A setting and the values it takes: of one method, or (`method` None) of all that have it."""

    method: str | None
    key: str
    values: tuple[str, ...]

    @classmethod
    def sweep(cls, text: str) -> Axis:
        """[METHOD.]KEY=VALUE,VALUE,...

        Raises:
            InputError: it is something else.
        """
        return cls._parse("--sweep [METHOD.]KEY=VALUE,VALUE,...", text, split=True)

    @classmethod
    def fixed(cls, text: str) -> Axis:
        """[METHOD.]KEY=VALUE; the value may hold commas.

        Raises:
            InputError: it is something else.
        """
        return cls._parse("--set [METHOD.]KEY=VALUE", text, split=False)

    @classmethod
    def _parse(cls, expected: str, text: str, *, split: bool) -> Axis:
        name, equals, right = text.partition("=")
        method, _, key = name.strip().rpartition(".")
        values = tuple(value.strip() for value in (right.split(",") if split else [right]))
        if not equals or not key or not all(values):
            raise InputError(f"expected {expected}, got {text!r}")
        if len(set(values)) < len(values):
            raise InputError(f"{text!r}: a value is there twice")
        if key == _SEED_SETTING:
            raise InputError(f"{text!r}: seeds are 0 to N-1 by --seeds N")
        if key == IMAGE_SCALE:
            for value in values:
                _check_scale(value, text)
        return cls(method or None, key, values)

    @property
    def name(self) -> str:
        return f"{self.method}.{self.key}" if self.method else self.key


def _check_scale(value: str, text: str) -> None:
    try:
        good = 0 < float(value) <= 1
    except ValueError:
        good = False
    if not good:
        raise InputError(f"{text!r}: expected image scales above 0 and up to 1, got {value!r}")


@dataclass(frozen=True)
class Method:
    """A reconstructor that takes part.

    Args:
        label: its short name, unlike those of the others.
        spec: as `pcbench.plugins.find_plugin` takes it.
        described: what is known of it before it runs.
    """

    label: str
    spec: str
    description: Description


@dataclass(frozen=True)
class Trial:
    """One run to make.

    Args:
        choices: what was chosen for it, image_scale among it if it was: one row of tables, one marker of charts.
        seed: None where the method has none.
    """

    method: Method
    choices: Mapping[str, str]
    seed: int | None

    @property
    def image_scale(self) -> float:
        return float(self.choices.get(IMAGE_SCALE, 1))

    @property
    def settings(self) -> dict[str, str]:
        """Those of the reconstructor."""
        own = {key: value for key, value in self.choices.items() if key != IMAGE_SCALE}
        return own if self.seed is None else {**own, _SEED_SETTING: str(self.seed)}

    @property
    def words(self) -> str:
        seed = () if self.seed is None else (f"seed {self.seed}",)
        return " ".join(filter(None, (self.method.label, choice_text(self.choices), *seed)))


def labels(specs: Sequence[str]) -> list[str]:
    """A short name for each spec: the class's, or all of the spec where two would be alike.

    Raises:
        InputError: a spec is there twice, or there is none.
    """
    if not specs:
        raise InputError("expected at least one --method: a name of `pcbench plugins`, MODULE:CLASS or FILE.py:CLASS")
    if twice := [spec for spec in specs if specs.count(spec) > 1]:
        raise InputError(f"the method {twice[0]} is there twice")
    short = [spec.rpartition(":")[2] for spec in specs]
    return [name if short.count(name) == 1 else spec for name, spec in zip(short, specs, strict=True)]


def trials(methods: Sequence[Method], axes: Sequence[Axis], seeds: int) -> tuple[list[Trial], list[str]]:
    """All runs in their order, and notes on what does not vary.

    Raises:
        InputError: a setting is given twice, no method has it, or there are more than 10,000 runs of one.
    """
    _check_axes(methods, axes)
    result: list[Trial] = []
    notes: list[str] = []
    for method in methods:
        chosen = dict(_choices(method, axes))
        notes += [
            f"{method.label} has no setting {axis.key!r}: its runs do not vary with it"
            for axis in axes
            if axis.method is None and axis.key not in chosen
        ]
        seeded = _has_setting(method, _SEED_SETTING)
        if seeds > 1 and not seeded:
            notes.append(f"{method.label} has no setting 'seed': one run instead of {seeds}")
        runs = math.prod(map(len, chosen.values())) * (seeds if seeded else 1)
        if runs > _MAX_RUNS_PER_METHOD:
            raise InputError(
                f"{method.label}: {runs:,} runs are asked for, expected at most {_MAX_RUNS_PER_METHOD:,}: sweep less"
            )
        for values in product(*chosen.values()):
            choices = dict(zip(chosen, values, strict=True))
            result += [Trial(method, choices, seed) for seed in (range(seeds) if seeded else (None,))]
    return result, notes


def _choices(method: Method, axes: Sequence[Axis]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """The settings that vary or are set, with their values; what names the method goes before what is for all."""
    own = {axis.key: axis.values for axis in axes if axis.method in (method.label, method.spec)}
    for axis in axes:
        if axis.method is None and (axis.key == IMAGE_SCALE or _has_setting(method, axis.key)):
            yield axis.key, own.get(axis.key, axis.values)
        elif axis.method in (method.label, method.spec):
            yield axis.key, axis.values


def _has_setting(method: Method, key: str) -> bool:
    return key in method.description.settings


def _check_axes(methods: Sequence[Method], axes: Sequence[Axis]) -> None:
    names = [axis.name for axis in axes]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{twice[0]} is given twice: put all its values into one --sweep")
    for axis in axes:
        theirs = [m for m in methods if axis.method in (None, m.label, m.spec)]
        if not theirs:
            there = ", ".join(method.label for method in methods)
            raise InputError(f"{axis.name}: there is no method {axis.method!r} in this bench: there are {there}")
        # What could not be looked at may have it: its run will tell.
        unknown = all(m.description.problem is None and not _has_setting(m, axis.key) for m in theirs)
        if axis.key != IMAGE_SCALE and unknown:
            there = "; ".join(f"{m.label} has {', '.join(m.description.settings) or 'none'}" for m in theirs)
            raise InputError(f"no method has the setting {axis.key!r}: {there}; the scene has image_scale")
