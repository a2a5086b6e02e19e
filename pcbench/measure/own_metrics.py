"""User-defined metrics: functions of an aligned pair of clouds, which the user names and all outputs show."""

from __future__ import annotations

import inspect
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError, Notice
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.neighbors import Index, Matches
from pcbench.io.named_code import CodeKind, code_file, error_summary
from pcbench.measure.intervals import Interval
from pcbench.measure.metrics import split_thresholds
from pcbench.measure.protocols.protocol import Better, ProtocolScore
from pcbench.measure.quantity import unit_name

ENTRY_POINT_GROUP = "pcbench.metrics"
FAILED_METRIC = "failed-metric"
"""Code of the warning that a metric is missing."""
_NAME = re.compile(r"[A-Za-z_][\w-]{0,79}", re.ASCII)
_INTERVALS = "ci"  # key of the intervals in comparison.json
_MAX_VALUES = 1000
_EXPECTED = "expected a metric as FILE.py:FUNCTION, MODULE:FUNCTION, the name of an installed one or fscore@THRESHOLD"


class MetricValue(NamedTuple):
    """A value with its interval or its unit, which a metric may return instead of a number.

    Attributes:
        value: the value; None: it does not exist for this pair.
        interval: lower and upper end of its 95 % confidence interval; None: unknown.
        unit: its unit, such as `deg`; `length` and `length^2` stand for the unit of the clouds, empty for none.
        better: whether `lower` or `higher` values are better, for rankings; None: neither.
    """

    value: float | None
    interval: tuple[float, float] | None = None
    unit: str = ""
    better: Better | None = None


@dataclass(frozen=True, eq=False)
class MeasuredWay:
    """The measured points of one cloud, and their closest points in the other. All arrays are read-only.

    Attributes:
        points: (M, 3) measured points, those inside the region.
        distances: (M,) distance of each one to its closest point.
        indices: (M,) row of the closest point in the complete other cloud.
        closest: (M, 3) closest points.
        normals: (M, 3) unit normals of the reference, at the closest points of `accuracy`, and at the points themselves
            of `completeness`; None if the reference has too few points for normals.
    """

    points: FloatArray
    distances: FloatArray
    indices: IntArray
    closest: FloatArray
    normals: FloatArray | None


@dataclass(frozen=True, eq=False)
class MeasuredPair:
    """Argument of a metric: an aligned pair with the closest points in both directions. All arrays are read-only.

    Attributes:
        candidate: (K, 3) all points of the aligned candidate.
        reference: (N, 3) all points of the reference.
        accuracy: the candidate's measured points and their closest points of the reference.
        completeness: the reference's measured points and their closest points of the candidate.
        origin: (3,) coordinates that were subtracted from all points, so that large ones lose no precision.
        unit: unit of the coordinates, if known.
    """

    candidate: FloatArray
    reference: FloatArray
    accuracy: MeasuredWay
    completeness: MeasuredWay
    origin: FloatArray
    unit: str | None

    @classmethod
    def of(
        cls,
        candidate: FloatArray,
        reference: FloatArray,
        forth: Matches,
        back: Matches,
        *,
        normals: FloatArray | None,
        origin: FloatArray,
        unit: str | None,
        candidate_rows: IntArray | None = None,
        reference_rows: IntArray | None = None,
    ) -> MeasuredPair:
        """Return the pair of two clouds.

        Args:
            candidate: (K, 3) aligned points minus `origin`.
            reference: (N, 3) points minus `origin`.
            forth: closest points of the measured points of the candidate.
            back: closest points of the measured points of the reference.
            normals: (N, 3) unit normals of the reference.
            origin: (3,) what was subtracted from the coordinates.
            unit: unit of the coordinates, if known.
            candidate_rows: rows of the measured points of the candidate; None: all.
            reference_rows: rows of the measured points of the reference; None: all.
        """
        ours = candidate if candidate_rows is None else candidate[candidate_rows]
        theirs = reference if reference_rows is None else reference[reference_rows]
        at_theirs = normals if normals is None or reference_rows is None else normals[reference_rows]
        return cls(
            _frozen(candidate),
            _frozen(reference),
            _way(ours, forth, reference, None if normals is None else normals[forth.indices]),
            _way(theirs, back, candidate, at_theirs),
            _frozen(origin),
            unit,
        )


MetricFunction = Callable[[MeasuredPair], float | MetricValue | Mapping[str, float | MetricValue]]


@dataclass(frozen=True)
class OwnMetric:
    """A metric that the user named.

    Attributes:
        name: its name in all outputs.
        text: how it was named: `FILE.py:function`, `module:function`, or the name of an installed one.
        function: the function.
        path: its file, if it was named by one.
    """

    name: str
    text: str
    function: MetricFunction
    path: Path | None = None

    @classmethod
    def of(cls, given: str | MetricFunction | OwnMetric) -> OwnMetric:
        """Return the metric that a text names, whose code is imported, or of a function.

        Raises:
            InputError: there is no such metric, or its name is not usable.
        """
        if isinstance(given, OwnMetric):
            return given
        name = metric_name(given)
        if not isinstance(given, str):
            return cls(name, f"{given.__module__}:{getattr(given, '__qualname__', name)}", given)
        function = _METRICS.find(given).value
        if not _is_metric(function):
            raise InputError(f"{given}: expected a function of a pair of clouds, got {_described(function)}")
        if (file := code_file(given)) is None:
            return cls(name, given, function)
        return cls(name, f"{file.absolute()}:{name}", function, file.absolute())

    @property
    def definition(self) -> str:
        """The first line of the function's docstring, or how it was named."""
        lines = (inspect.getdoc(self.function) or "").strip().splitlines()
        return lines[0] if lines else f"metric {self.text}"


@dataclass(frozen=True)
class OwnResult:
    """Values that a user-defined metric returned.

    Attributes:
        definition: definition of the metric in words.
        values: its values by key; a single number has the key "". Empty: the metric failed.
    """

    definition: str
    values: Mapping[str, MetricValue] = field(default_factory=dict)

    @property
    def value(self) -> float | None:
        """The value of a metric that returns a single number; None if it does not exist."""
        return self.values[""].value if "" in self.values else None


class OwnResults(NamedTuple):
    """The results of metrics by name, and warnings about those that failed."""

    by_name: Mapping[str, OwnResult]
    warnings: tuple[Notice, ...]

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the metrics that failed."""
        return tuple(name for name, result in self.by_name.items() if not result.values)


def metric_name(given: str | MetricFunction | OwnMetric) -> str:
    """Return the name of a metric in all outputs, without importing it.

    Raises:
        InputError: it has none, or one that cannot be part of a document.
    """
    if isinstance(given, OwnMetric):
        return given.name
    if isinstance(given, str):
        name = given.rpartition(":")[2]
    elif _is_metric(given):
        name = getattr(given, "__name__", "")
    else:
        raise InputError(f"{_EXPECTED}, or a function, got {_described(given)}")
    if not _NAME.fullmatch(name) or name == _INTERVALS:
        if isinstance(given, str):
            raise InputError(f"{_EXPECTED}, got {given!r}")
        raise InputError(f"expected a metric as a function that def defines, with a name of letters, got {name!r}")
    return name


def check_metrics(given: Any) -> tuple[str | OwnMetric, ...]:
    """Return metrics with different names; functions become metrics, and texts are not yet imported.

    Raises:
        InputError: a metric has no usable name, or two have the same one.
    """
    checked = tuple(metric if isinstance(metric, str) else OwnMetric.of(metric) for metric in _several(given))
    names = [metric_name(metric) for metric in checked]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise InputError(f"two metrics are called {twice[0]!r}: rename one of them")
    return checked


def split_metrics(given: Any) -> tuple[tuple[str | OwnMetric, ...], tuple[float, ...]]:
    """Return user-defined metrics as `check_metrics` does, and the thresholds of texts such as `fscore@0.05`.

    Raises:
        InputError: as `check_metrics`, or a threshold is not a length above 0.
    """
    others, thresholds = split_thresholds(_several(given))
    return check_metrics(others), thresholds


def _several(given: Any) -> Iterable[Any]:
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise InputError(f"expected metrics as several functions or texts, in a tuple or list, got {given!r}")
    return given


def measure_own(metrics: Sequence[OwnMetric], pair: MeasuredPair) -> OwnResults:
    """Call metrics with a pair. One that fails has no values, and a warning says why.

    What it prints goes to standard error. Ctrl-C ends it.
    """
    results, warnings = {}, list[Notice]()
    for metric in metrics:
        values: dict[str, MetricValue]
        try:
            with redirect_stdout(sys.stderr):
                returned = metric.function(pair)
        except (Exception, SystemExit) as error:  # it may raise anything
            values, problem = {}, error_summary(error, _files_of(metric.function))
        else:
            values, problem = _values(returned)
            problem = problem and f"{problem}{_place(metric.function)}"
        results[metric.name] = OwnResult(metric.definition, values)
        if problem:
            warnings.append(Notice(FAILED_METRIC, f"the metric {metric.name} is missing: {problem}"))
    return OwnResults(results, tuple(warnings))


def own_metrics_between(
    metrics: Sequence[OwnMetric],
    candidate: Cloud | ArrayLike,
    reference: Cloud | ArrayLike,
    *,
    unit: str | None = None,
) -> OwnResults:
    """Call metrics with two clouds as they are: nothing is registered, cropped or weighted.

    Normals are those that the reference has, if any.
    """
    ours, theirs = as_cloud(candidate), as_cloud(reference)
    origin = np.floor(theirs.points.mean(axis=0))
    first, second = Index(ours.points - origin), Index(theirs.points - origin)
    pair = MeasuredPair.of(
        first.points,
        second.points,
        second.query(first.points),
        first.query(second.points),
        normals=theirs.normals,
        origin=origin,
        unit=unit or theirs.unit,
    )
    return measure_own(metrics, pair)


def own_scores(results: OwnResults, unit: str | None) -> tuple[ProtocolScore, ...]:
    """Return the values of metrics as scores of a protocol, named as in conditions: `own.NAME` or `own.NAME.KEY`.

    Args:
        results: the results; a metric that failed has a score without a value.
        unit: unit of the clouds, if known.
    """
    return tuple(
        ProtocolScore(f"own.{name}.{key}".rstrip("."), value.value, unit_name(value.unit, unit or ""), value.better)
        for name, result in results.by_name.items()
        for key, value in (result.values or {"": MetricValue(None)}).items()
    )


def _is_metric(value: Any) -> bool:
    return callable(value) and not inspect.isclass(value)


_METRICS = CodeKind(ENTRY_POINT_GROUP, "metric", "FUNCTION", inspect.isfunction)


def installed_metrics() -> tuple[str, ...]:
    """Return the names of the installed user-defined metrics, sorted."""
    return _METRICS.installed_names()


def _way(points: FloatArray, matches: Matches, others: FloatArray, normals: FloatArray | None) -> MeasuredWay:
    return MeasuredWay(
        _frozen(points),
        _frozen(matches.distances),
        _frozen(matches.indices),
        _frozen(others[matches.indices]),
        None if normals is None else _frozen(normals),
    )


def _frozen(array: Any) -> Any:
    """Return a read-only view of an array."""
    view = array.view()
    view.flags.writeable = False
    return view


def _values(returned: Any) -> tuple[dict[str, MetricValue], str]:
    """Return the values that a metric returned by key, and what is wrong with them; none or empty."""
    if not isinstance(returned, Mapping):
        returned = {"": returned}
    elif problem := next(_wrong_keys(returned), ""):
        return {}, problem
    values = {}
    for key, given in returned.items():
        value = given if isinstance(given, MetricValue) else MetricValue(given)
        unit: Any = value.unit  # code of the user may return anything
        name = f" for {key!r}" if key else ""
        if given is None or not (value.value is None or _is_number(value.value)):
            return {}, f"expected a finite number{name}, got {_described(value.value)}"
        if value.interval is not None and not _is_interval(value.interval):
            return {}, f"expected an interval of two finite numbers{name}, got {_described(value.interval)}"
        if not isinstance(unit, str):
            return {}, f"expected a unit as text{name}, got {_described(unit)}"
        if value.better not in (None, *get_args(Better)):
            return {}, f"expected better as 'lower', 'higher' or None{name}, got {_described(value.better)}"
        interval = None if value.interval is None else Interval(*map(float, value.interval))
        values[key] = MetricValue(None if value.value is None else float(value.value), interval, unit, value.better)
    return values, ""


def _wrong_keys(returned: Mapping[Any, Any]) -> Iterator[str]:
    if not 0 < len(returned) <= _MAX_VALUES:
        yield f"expected 1 to {_MAX_VALUES} values, got {len(returned):,}"
    for key in returned:
        if not isinstance(key, str) or not _NAME.fullmatch(key) or key == _INTERVALS:
            yield f"expected names of values as identifiers, got {_described(key)}"


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond the largest float
        return False


def _is_interval(value: Any) -> bool:
    return isinstance(value, tuple | list) and len(value) == 2 and all(map(_is_number, value)) and value[0] <= value[1]


def _described(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array {value.shape}"
    if isinstance(value, float | str | tuple | bool | np.generic | None):
        text = repr(value)
        return text if len(text) <= 60 else f"{text[:60]}..."
    return f"the class {value.__name__}" if inspect.isclass(value) else f"an object of type {type(value).__name__}"


def _files_of(function: Callable[..., Any]) -> list[str]:
    code = getattr(inspect.unwrap(function), "__code__", None)
    return [] if code is None else [code.co_filename]


def _place(function: Callable[..., Any]) -> str:
    """Return the file and the line of a function in parentheses, if it has one."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return "" if code is None else f" ({code.co_filename}, line {code.co_firstlineno})"
