"""The runs of a bench: each method with each combination of settings and each seed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from pcbench.errors import InputError
from pcbench.plugins.run import Description
from pcbench.studies.bench.results import choice_text

IMAGE_SCALE = "image_scale"  # a setting of the scene; all other names are settings of the method
_MAX_RUNS_PER_METHOD = 10_000
_SEED_SETTING = "seed"


@dataclass(frozen=True)
class Axis:
    """A setting and its values, for one method or (`method` is None) for all methods that have it."""

    method: str | None
    key: str
    values: tuple[str, ...]

    @classmethod
    def sweep(cls, text: str) -> Axis:
        """Parse `[METHOD.]KEY=VALUE,VALUE,...`.

        Raises:
            InputError: the text has another form.
        """
        return cls._parse("--sweep [METHOD.]KEY=VALUE,VALUE,...", text, split=True)

    @classmethod
    def setting(cls, text: str) -> Axis:
        """Parse `[METHOD.]KEY=VALUE`; the value may contain commas.

        Raises:
            InputError: the text has another form.
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
            raise InputError(f"{text!r}: expected different values, got one of them twice")
        if key == _SEED_SETTING:
            raise InputError(f"{text!r}: expected a setting other than seed; --seeds N runs seeds 0 to N-1")
        if key == IMAGE_SCALE:
            for value in values:
                _check_scale(value, text)
        return cls(method or None, key, values)

    @property
    def name(self) -> str:
        """Name of the setting, with its method if it belongs to one."""
        return f"{self.method}.{self.key}" if self.method else self.key


def _check_scale(value: str, text: str) -> None:
    try:
        good = 0 < float(value) <= 1
    except ValueError:
        good = False
    if not good:
        raise InputError(f"{text!r}: expected image scales above 0 and at most 1, got {value!r}")


@dataclass(frozen=True)
class Method:
    """A reconstructor in the bench.

    Args:
        label: short unique name.
        spec: specification for `pcbench.plugins.find_plugin`.
        description: what the reconstructor reports about itself before it runs.
    """

    label: str
    spec: str
    description: Description


@dataclass(frozen=True)
class Trial:
    """One planned run.

    Args:
        method: the reconstructor.
        choices: chosen settings, including image_scale if it was chosen; one row of the tables, one marker of the
            charts.
        seed: random seed; None if the method has none.
    """

    method: Method
    choices: Mapping[str, str]
    seed: int | None

    @property
    def image_scale(self) -> float:
        """Image scale of the run."""
        return float(self.choices.get(IMAGE_SCALE, 1))

    @property
    def settings(self) -> dict[str, str]:
        """Settings of the reconstructor, including its seed."""
        own = {key: value for key, value in self.choices.items() if key != IMAGE_SCALE}
        return own if self.seed is None else {**own, _SEED_SETTING: str(self.seed)}

    @property
    def title(self) -> str:
        """Method, settings and seed as text."""
        seed = () if self.seed is None else (f"seed {self.seed}",)
        return " ".join(filter(None, (self.method.label, choice_text(self.choices), *seed)))


def labels(specs: Sequence[str]) -> list[str]:
    """Return a short name per spec: its class name, or the complete spec if two class names are equal.

    Raises:
        InputError: there is no spec, or one occurs twice.
    """
    if not specs:
        raise InputError("expected at least one --method: a name of `pcbench plugins`, MODULE:CLASS or FILE.py:CLASS")
    if twice := [spec for spec in specs if specs.count(spec) > 1]:
        raise InputError(f"expected different methods, got {twice[0]} twice")
    short = [spec.rpartition(":")[2] for spec in specs]
    return [name if short.count(name) == 1 else spec for name, spec in zip(short, specs, strict=True)]


def trials(methods: Sequence[Method], axes: Sequence[Axis], seeds: int) -> tuple[list[Trial], list[str]]:
    """List all runs in order, with notes on settings that do not vary.

    Args:
        methods: reconstructors.
        axes: settings and their values.
        seeds: number of seeds.

    Raises:
        InputError: a setting occurs twice, no method has it, or one method has more than 10,000 runs.
    """
    _check_axes(methods, axes)
    result: list[Trial] = []
    notes: list[str] = []
    for method in methods:
        chosen = dict(_choices(method, axes))
        notes += [
            f"{method.label} has no setting {axis.key!r}, so its runs do not vary in it"
            for axis in axes
            if axis.method is None and axis.key not in chosen
        ]
        seeded = _has_setting(method, _SEED_SETTING)
        if seeds > 1 and not seeded:
            notes.append(f"{method.label} has no setting 'seed': one run instead of {seeds}")
        runs = math.prod(map(len, chosen.values())) * (seeds if seeded else 1)
        if runs > _MAX_RUNS_PER_METHOD:
            raise InputError(
                f"{method.label}: expected at most {_MAX_RUNS_PER_METHOD:,} runs, got {runs:,}; sweep fewer values"
            )
        for values in product(*chosen.values()):
            choices = dict(zip(chosen, values, strict=True))
            result += [Trial(method, choices, seed) for seed in (range(seeds) if seeded else (None,))]
    return result, notes


def _choices(method: Method, axes: Sequence[Axis]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield varying or set settings with their values; an axis of the method overrides one of all methods."""
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
        raise InputError(f"expected each setting once, got {twice[0]} twice; put all its values into one --sweep")
    for axis in axes:
        theirs = [m for m in methods if axis.method in (None, m.label, m.spec)]
        if not theirs:
            there = ", ".join(method.label for method in methods)
            raise InputError(f"{axis.name}: expected a method of this bench ({there}), got {axis.method!r}")
        # A method that could not be described may have the setting; its run will show.
        unknown = all(m.description.problem is None and not _has_setting(m, axis.key) for m in theirs)
        if axis.key != IMAGE_SCALE and unknown:
            there = "; ".join(f"{m.label} has {', '.join(m.description.settings) or 'none'}" for m in theirs)
            raise InputError(f"no method has the setting {axis.key!r}: {there}; image_scale is a setting of the scene")
