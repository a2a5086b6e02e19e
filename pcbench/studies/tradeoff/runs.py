"""All runs of a study: rounds of the exact comparison and each approximation, measured alike."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from pcbench.errors import InputError, PcbenchError, record_error
from pcbench.extras import package_version
from pcbench.measure.results import Candidate
from pcbench.regular_files import read_json_object
from pcbench.studies.frame.records import read_record, write_record
from pcbench.studies.tradeoff.approximations import EXACT, Approximation, Pair
from pcbench.studies.tradeoff.metrics import (
    DEFORMATION_RMS,
    NAMES,
    corrected_values,
    deformation_rms,
    metric_floors,
    metric_values,
)
from pcbench.studies.tradeoff.results import ComparisonRun, TradeoffSettings
from pcbench.systems import peak_memory_since_reset, release_free_memory, reset_peak_memory


def run_all(
    pair: Pair,
    approximations: Sequence[Approximation],
    settings: TradeoffSettings,
    records: Path | None,
    step: Callable[[str], None],
) -> Iterator[ComparisonRun]:
    """Yield the runs of all rounds, each of which begins with the exact comparison.

    Alternating runs share the load of the machine, so that ratios of their CPU seconds within a round are fair.

    Args:
        pair: pair of clouds.
        approximations: approximations.
        settings: settings of the study.
        records: folder of the records of runs; finished rounds are not repeated. None: nothing is recorded.
        step: progress callback.

    Raises:
        InputError: the exact comparison fails; the message is its error.
        OSError: a record cannot be written.
    """
    is_warm = False
    for number in range(settings.seeds):
        seed = settings.seed + number
        files = _record_files(pair, approximations, seed, records)
        recorded = [run for file in files if (run := _recorded_run(*file)) is not None]
        if recorded and len(recorded) == len(files):
            yield from recorded
            continue
        # The CPU seconds of a round are comparable only if they come from one session.
        for place, approximation in enumerate((EXACT, *approximations)):
            step(f"round {number + 1} of {settings.seeds}: {approximation.name or 'exact'}")
            if not is_warm:
                _fail_without_exact(_run(pair, EXACT, seed))  # the first comparison of a process also loads libraries
                is_warm = True
            run = _run(pair, approximation, seed)
            if approximation is EXACT:
                _fail_without_exact(run)
            if files and not run.message:  # a library may be installed later
                write_record(files[place].path, files[place].key, run)
            yield run


def check_pair(pair: Pair, records: Path) -> None:
    """Check that the records of a folder, if there are any, belong to a pair.

    Raises:
        InputError: they belong to another pair.
    """
    for path in records.glob("exact_*.json"):
        key = read_json_object(path).get("key")
        if isinstance(key, dict) and key.get("clouds") not in (pair.digest, None):
            raise InputError(f"{records.parent}: the folder holds the study of another pair: choose another folder")


class _RecordFile(NamedTuple):
    """File of a run's record, and the inputs that the run depends on."""

    path: Path
    key: dict[str, Any]


def _record_files(
    pair: Pair, approximations: Sequence[Approximation], seed: int, records: Path | None
) -> list[_RecordFile]:
    """Return the files of a round, that of the exact comparison first; none without a folder."""
    if records is None:
        return []
    shared = {"pcbench": package_version(), "clouds": pair.digest, "settings": pair.settings.plain(), "seed": seed}
    return [
        _RecordFile(
            records / f"{_file_stem(one.name or 'exact')}_{seed}.json",
            {**shared, "approximation": one.name, "instruction": one.instruction},
        )
        for one in (EXACT, *approximations)
    ]


def _recorded_run(path: Path, key: dict[str, Any]) -> ComparisonRun | None:
    """Return a recorded run; None if there is none, or if it is damaged."""
    run = read_record(path, key, ComparisonRun)
    return run if run is not None and set(run.values) == set(NAMES) else None


def _fail_without_exact(run: ComparisonRun) -> None:
    if run.message:
        raise InputError(run.message)


def _run(pair: Pair, approximation: Approximation, seed: int) -> ComparisonRun:
    """Run one comparison and measure its costs; what stops it is its message."""
    release_free_memory()  # freed memory that is reused would not count
    before = reset_peak_memory()
    cpu, wall = _cpu_seconds(), time.perf_counter()
    try:
        comparison = approximation.measure(pair, seed)
    except PcbenchError as error:
        return ComparisonRun(approximation.name, seed, message=record_error(error))
    except MemoryError as error:
        record_error(error)
        return ComparisonRun(approximation.name, seed, message="it needs more memory than is available")
    peak = peak_memory_since_reset()
    run = _measured(pair, approximation, seed, comparison)
    return replace(
        run,
        cpu_s=_cpu_seconds() - cpu,
        wall_s=time.perf_counter() - wall,
        memory_bytes=None if before is None or peak is None else max(0, peak - before),
    )


def _measured(pair: Pair, approximation: Approximation, seed: int, comparison: Candidate) -> ComparisonRun:
    values = {**metric_values(comparison.metrics), DEFORMATION_RMS: deformation_rms(comparison)}
    floors = metric_floors(comparison.metrics)
    points = len(comparison.completeness.rows), comparison.points
    corrected: Mapping[str, float | None] = {}
    if any(approximation.thinned):
        # The distance c→r is measured to the reference, r→c to the candidate.
        totals = len(pair.reference), len(pair.candidate)
        reference_share, candidate_share = (
            now / total if is_thinned else 1.0  # a mesh is measured by samples: its length counts faces
            for now, total, is_thinned in zip(points, totals, approximation.thinned, strict=True)
        )
        corrected = corrected_values(values, floors, {"c→r": reference_share, "r→c": candidate_share})
    return ComparisonRun(approximation.name, seed, values, floors, corrected, comparison.deformation.verdict, points)


def _file_stem(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in ".=" else "-" for letter in name)


def _cpu_seconds() -> float:
    """Return the CPU seconds of this process and of its ended children."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system
