"""Evaluate the pairs of a plan, in this process or on workers; earlier results of the same inputs are reused."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError, PcbenchError, one_line, reason_of, record_error
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh_samples import sample_reference
from pcbench.geometry.region_text import parse_region, region_file
from pcbench.geometry.regions import Region
from pcbench.io.contents import digest
from pcbench.io.named_code import code_file
from pcbench.io.source import Source
from pcbench.measure.protocols.protocol import EvaluationInputs, ProtocolScore
from pcbench.measure.protocols.registry import parse_protocol
from pcbench.registration import parse_method, register
from pcbench.registration.given import GivenPose, method_files
from pcbench.studies.evaluate.plan import PlannedPair
from pcbench.studies.evaluate.results import FAILED, MISSING, OK, PairEvaluation, PairRecord, ScoreColumn, Status
from pcbench.studies.frame.cells import map_cells
from pcbench.studies.frame.folder import unique_name
from pcbench.studies.frame.records import read_record, write_record
from pcbench.tasks import Workers

PAIRS, RECORD = "pairs", "evaluation.json"
_PAIR_SECONDS = 1.0  # rough duration of the evaluation of a pair, for progress
_NO_REFERENCE = Cloud(np.zeros((1, 3)))  # for regions that do not depend on the reference
_UNSAFE = re.compile(r"[^\w.-]+")


@dataclass(frozen=True)
class PairTask:
    """A pair, and the folder of its report relative to that of the evaluation; empty if nothing is written."""

    pair: PlannedPair
    folder: str


@dataclass(frozen=True)
class SharedSettings:
    """Settings that all pairs share.

    Attributes:
        out: folder of the evaluation; None: results are not stored.
        protocol: protocol as on the command line.
        data: folder with files of the benchmark; None: there is none.
        data_state: digest of the names, sizes and times of these files.
        seed: seed of random samples and orders.
        code: digest of the code that the results depend on.
        metrics: user-defined metrics, with absolute paths.
    """

    out: Path | None
    protocol: str
    data: Path | None
    data_state: str
    seed: int
    code: str
    metrics: tuple[str, ...] = ()


def evaluate_pairs(
    pairs: Sequence[PlannedPair],
    shared: SharedSettings,
    scratch: Path,
    workers: Workers | None,
    step: Callable[[str], None],
    columns: Sequence[str] = (),
) -> list[PairRecord]:
    """Evaluate all pairs that have no result of the same inputs yet, and return the results of all in their order.

    A pair that cannot be evaluated has a message instead of scores.

    Args:
        pairs: pairs, by scene, so that a worker reads a reference once for several methods.
        shared: what they share.
        scratch: existing folder for temporary files.
        workers: where they are evaluated; None: in this process, one after another.
        step: progress callback.
        columns: names of scores that the user asked for, which the first pair with scores must have.

    Raises:
        InputError: no score has one of these names.
        WorkerError: a cluster cannot be used.
        OSError: a result cannot be written.
    """
    tasks = pair_tasks(pairs, is_stored=shared.out is not None)
    results = map_cells(
        evaluate_task,
        shared,
        tasks,
        out=scratch,
        workers=workers,
        step=step,
        cell_seconds=_PAIR_SECONDS,
        on_failure=lambda task, error: _without_scores(shared, task, FAILED, str(error)),
    )
    records: list[PairRecord] = []
    with closing(results):  # ends the workers if a name is unknown
        for record in results:
            if all(earlier.pair.status != OK for earlier in records):
                check_columns(columns, record)
            records.append(record)
    return records


def check_columns(names: Iterable[str], record: PairRecord) -> None:
    """Check that the scores of a pair have all of these names, if it has scores; those of failed metrics are unknown.

    Raises:
        InputError: one is unknown.
    """
    stored = [column.name for column in record.columns]
    failed = tuple(f"own.{metric}." for metric in record.pair.failed_metrics)
    for name in names if stored else ():
        if name not in stored and not name.startswith(failed):
            raise InputError(f"no score is called {name!r}: expected --columns of {', '.join(stored)}")


def pair_tasks(pairs: Iterable[PlannedPair], *, is_stored: bool) -> list[PairTask]:
    """Return pairs with different names of folders."""
    tasks: list[PairTask] = []
    names: set[str] = set()
    for pair in pairs:
        stem = _UNSAFE.sub("_", f"{pair.method}_{pair.scene}").strip(".") or "pair"
        name = unique_name(stem.lower(), names)  # some file systems do not distinguish upper and lower case
        names.add(name)
        tasks.append(PairTask(pair, f"{PAIRS}/{stem}{name[len(stem) :]}" if is_stored else ""))
    return tasks


def evaluate_task(shared: SharedSettings, task: PairTask, step: Callable[[str], None]) -> PairRecord:
    """Evaluate a pair, or return its stored result; errors become messages."""
    pair = task.pair
    if pair.missing:
        return _without_scores(shared, task, MISSING, pair.missing)
    try:
        file = None if shared.out is None else shared.out / task.folder / RECORD
        key = None if file is None else _key(shared, pair)
        stored = None if file is None or key is None else read_record(file, key, PairRecord)
        if stored is not None and stored.pair.status == OK:
            return replace(stored, pair=replace(stored.pair, seconds=pair.seconds, folder=task.folder))
        record = _evaluate(shared, task, step)
    except MemoryError:
        return _without_scores(shared, task, FAILED, "not enough memory: use fewer workers (--workers)")
    except OSError as error:
        return _without_scores(shared, task, FAILED, f"{error.filename or pair.candidate}: {reason_of(error)}")
    except PcbenchError as error:
        return _without_scores(shared, task, FAILED, record_error(error))
    except Exception as error:  # one pair does not end the others
        return _without_scores(shared, task, FAILED, f"{type(error).__name__}: {record_error(error)}")
    _write(file, key, record)
    return record


def evaluate_alone(shared: SharedSettings, pair: PlannedPair, step: Callable[[str], None]) -> PairRecord:
    """Evaluate the only pair, whose errors are those of the command."""
    (task,) = pair_tasks([pair], is_stored=shared.out is not None)
    if pair.missing:
        raise InputError(pair.missing)
    record = _evaluate(shared, task, step)
    if shared.out is not None:
        _write(shared.out / task.folder / RECORD, _key(shared, pair), record)
    return record


def _evaluate(shared: SharedSettings, task: PairTask, step: Callable[[str], None]) -> PairRecord:
    """Evaluate a pair in its pose.

    Raises:
        PcbenchError: a file cannot be read, or the protocol cannot evaluate it.
    """
    pair, protocol, start = task.pair, parse_protocol(shared.protocol), time.perf_counter()
    pose, notes = None, list[str]()
    method = parse_method(pair.register)
    if isinstance(method, GivenPose):
        pose = None if pair.register == "none" else method.T_reference_candidate
    else:
        step("registering")
        registration = register(Path(pair.reference), Path(pair.candidate), method)
        pose = registration.T_reference_candidate
        notes += [f"registration: {warning}" for warning in registration.warnings]
    inputs = replace(_paths(shared, pair), pose=pose, crop=_region(pair), metrics=shared.metrics, on_step=step)
    evaluation = protocol.evaluate(inputs)
    result = PairEvaluation(
        pair.scene,
        pair.method,
        status=OK,
        scores={score.name: score.value for score in evaluation.scores},
        reference=pair.reference,
        candidate=pair.candidate,
        register=pair.register,
        crop=pair.crop,
        seconds=pair.seconds,
        evaluation_s=time.perf_counter() - start,
        counts={count.name: count.value for count in evaluation.counts},
        notes=(*notes, *map(one_line, evaluation.notes)),
        failed_metrics=evaluation.failed_metrics,
        folder=task.folder,
    )
    return PairRecord(result, evaluation.protocol, _columns(evaluation.scores), _columns(evaluation.counts))


def _paths(shared: SharedSettings, pair: PlannedPair) -> EvaluationInputs:
    """Return the inputs of a pair without its pose and region."""
    return EvaluationInputs(
        Path(pair.reference), Path(pair.candidate), scene=pair.scene, data=shared.data, seed=shared.seed
    )


def _columns(scores: Iterable[ProtocolScore]) -> tuple[ScoreColumn, ...]:
    return tuple(ScoreColumn(score.name, score.unit, score.better) for score in scores)


def check_crop(text: str) -> None:
    """Refuse the text of an invalid region before any work; a file may be missing for some pairs.

    Raises:
        InputError: it is none of the forms of `pcbench.parse_region`.
    """
    if region_file(text) is None and not _is_relative(text):
        parse_region(text, _NO_REFERENCE)


def _region(pair: PlannedPair) -> Region | None:
    """Return the region of a pair; its reference is read only if the region is relative to it."""
    if not _is_relative(pair.crop):
        return parse_region(pair.crop, _NO_REFERENCE)
    shape = Source.open(pair.reference).read(lambda _: None)
    return parse_region(pair.crop, sample_reference(shape))


def _is_relative(text: str) -> bool:
    """Return whether a region depends on the reference."""
    return text.partition(":")[0].strip().lower() in ("reference", "quantile")


def _without_scores(shared: SharedSettings, task: PairTask, status: Status, message: str) -> PairRecord:
    """Return and store the record of a pair without scores, which a later run evaluates again."""
    pair = task.pair
    result = PairEvaluation(
        pair.scene,
        pair.method,
        status,
        message,
        reference=pair.reference,
        candidate=pair.candidate,
        register=pair.register,
        crop=pair.crop,
        seconds=pair.seconds,
        folder=task.folder,
    )
    record = PairRecord(result, shared.protocol)
    _write(None if shared.out is None else shared.out / task.folder / RECORD, {}, record)
    return record


def _write(file: Path | None, key: Mapping[str, Any] | None, record: PairRecord) -> None:
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_record(file, key or {}, record)


def _key(shared: SharedSettings, pair: PlannedPair) -> dict[str, Any]:
    """Return all that the scores of a pair depend on; the contents of its files are read."""
    files = [Path(pair.reference), Path(pair.candidate), *method_files(pair.register), region_file(pair.crop)]
    files += map(code_file, shared.metrics)
    others = parse_protocol(shared.protocol).other_files(_paths(shared, pair))
    files += [file for file in others if file.exists()]
    return {
        "pair": {name: value for name, value in asdict(pair).items() if name not in ("seconds", "missing")},
        "protocol": shared.protocol,
        "data": shared.data_state,
        "seed": shared.seed,
        "metrics": list(shared.metrics),
        "code": shared.code,
        "sha256": {str(file): digest(file) for file in files if file is not None},
    }
