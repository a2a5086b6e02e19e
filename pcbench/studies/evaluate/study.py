"""`pcbench evaluate`: scenes and methods by one protocol, in one table.

Pairs run in parallel, and each keeps its own report. Means over scenes are compared with intervals of paired
differences, so that "better" is told from chance.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from pcbench.errors import InputError
from pcbench.geometry.region_text import region_file
from pcbench.io.contents import status_of
from pcbench.io.named_code import code_file
from pcbench.measure.metrics import split_thresholds
from pcbench.measure.own_metrics import OwnMetric, check_metrics
from pcbench.measure.protocols.preset import PcbenchProtocol
from pcbench.measure.protocols.protocol import BenchmarkProtocol, protocol_text
from pcbench.measure.protocols.registry import parse_protocol
from pcbench.registration import METHODS, parse_method
from pcbench.registration.given import method_files
from pcbench.report.document import provenance
from pcbench.report.html import PAGE, Origin, article_page, write_page
from pcbench.report.plot import Drawn
from pcbench.studies.evaluate.charts import draw_charts
from pcbench.studies.evaluate.means import LEVEL, means_over_scenes
from pcbench.studies.evaluate.page import article, pair_article
from pcbench.studies.evaluate.plan import EvaluationPlan, PlannedPair, check_pairs, plan_csv, plan_patterns
from pcbench.studies.evaluate.results import (
    KIND,
    EvaluateSettings,
    MethodComparison,
    PairRecord,
    ProtocolInfo,
    ScoreColumn,
)
from pcbench.studies.evaluate.runs import SharedSettings, check_columns, check_crop, evaluate_alone, evaluate_pairs
from pcbench.studies.evaluate.table import evaluate_csv, evaluate_latex, means_csv
from pcbench.studies.evaluate.words import answer, matched_methods, warnings
from pcbench.studies.frame.code import measuring_code_digest
from pcbench.studies.frame.folder import check_folder, study_folder
from pcbench.studies.frame.publish import StudyOutcome, draw_here, publish
from pcbench.systems import cpu_count
from pcbench.tasks import Workers
from pcbench.tasks.codec import fingerprint

CSV, MEANS, LATEX = "evaluate.csv", "means.csv", "evaluate.tex"
_OWN_MODULES = ("runs",)  # of this study, on which the scores of a pair depend


def evaluate(
    reference: str | os.PathLike[str] | None = None,
    candidates: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = (),
    *,
    pairs: str | os.PathLike[str] | Sequence[PlannedPair] | None = None,
    protocol: str | BenchmarkProtocol = "pcbench",
    protocol_data: str | os.PathLike[str] | None = None,
    columns: Sequence[str] = (),
    metrics: Sequence[str] = (),
    register: str = "none",
    crop: str = "none",
    seed: int = 0,
    workers: int | None = None,
    cluster: str | None = None,
    out: str | os.PathLike[str] | None = None,
    step: Callable[[str], None] = lambda _: None,
) -> MethodComparison:
    """Evaluate methods on scenes by one protocol; `MethodComparison.table` returns a tidy data frame.

    Args:
        reference: path of the references, with the placeholder {scene} if there are several.
        candidates: path of the candidates with {scene} and {method}, or one path for each method, as `PATTERN` or
            `NAME=PATTERN`.
        pairs: instead of these, a CSV file as for `pcbench evaluate --pairs`, or `PlannedPair`s.
        protocol: a protocol, or its text such as `dtu` or `pcbench:thresholds=0.01/0.02`.
        protocol_data: folder with files of the benchmark.
        columns: names of the scores in tables and in the answer; none: all. `fscore@0.05` adds 0.05 to the thresholds
            of the protocol.
        metrics: user-defined metrics, as `FILE.py:function`, `module:function` or the name of an installed one, which
            only the protocol `pcbench` computes; or `fscore@0.05`, as for `columns`.
        register: how poses are determined, as for `pcbench.register`; {scene} and {method} are replaced.
        crop: region, as for `pcbench.parse_region`; {scene} and {method} are replaced.
        seed: seed of random samples and orders, and of the bootstrap.
        workers: number of pairs at the same time; None: as many as CPUs.
        cluster: address of a Dask scheduler, or its scheduler file.
        out: folder for all results, from which a later call resumes; None: nothing is written.
        step: progress callback.

    Raises:
        InputError: no file matches, a setting is not usable, or no score has a name of `columns`. With a single pair
            also if it cannot be evaluated; otherwise such a pair has a message in the result.
        OSError: a file cannot be written.
    """
    text = protocol if isinstance(protocol, str) else protocol_text(protocol)
    data = None if protocol_data is None else os.fspath(protocol_data)
    settings = EvaluateSettings(text, data, tuple(columns), seed, workers, cluster, tuple(metrics))
    plan = make_plan(reference, candidates, pairs, register=register, crop=crop)
    folder = None if out is None else Path(out)
    return run_evaluation(plan, settings, out=folder, figures=folder is not None, step=step).study


def make_plan(
    reference: str | os.PathLike[str] | None,
    candidates: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    pairs: str | os.PathLike[str] | Sequence[PlannedPair] | None,
    *,
    register: str,
    crop: str,
) -> EvaluationPlan:
    """Return the pairs of patterns, of a CSV file, or as they are given.

    Raises:
        InputError: both or neither of them are given, or one is not usable.
    """
    paths = [candidates] if isinstance(candidates, str | os.PathLike) else list(candidates)
    if pairs is not None:
        if reference is not None or paths:
            raise InputError("expected patterns or pairs, got both")
        if isinstance(pairs, str | os.PathLike):
            return plan_csv(Path(pairs), register=register, crop=crop)
        check_pairs(pairs, "pairs")
        return EvaluationPlan(tuple(pairs))
    if reference is None or not paths:
        raise InputError("expected a reference and candidates, or a CSV file of pairs")
    return plan_patterns(os.fspath(reference), [os.fspath(path) for path in paths], register=register, crop=crop)


def run_evaluation(
    plan: EvaluationPlan,
    settings: EvaluateSettings,
    *,
    out: Path | None = None,
    figures: bool = True,
    step: Callable[[str], None] = lambda _: None,
) -> StudyOutcome[MethodComparison]:
    """Evaluate the pairs of a plan; with `out`, write all results to a folder, from which a later run resumes.

    Raises:
        InputError: a setting is not usable, `out` holds something else, or the only pair cannot be evaluated.
        OSError: a file cannot be written.
    """
    protocol, settings = _with_named_thresholds(settings)
    if settings.metrics and protocol.name != PcbenchProtocol.name:
        raise InputError(
            f"expected the protocol pcbench with user-defined metrics, got {protocol.name}: evaluate once for each"
        )
    check_inputs(plan.pairs, settings, out)
    for pair in {(pair.register, pair.crop): pair for pair in plan.pairs if not pair.missing}.values():
        _check_method(pair.register)
        check_crop(pair.crop)
    with ExitStack() as stack:
        if out is None:
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        else:
            check_folder(out, KIND)
            stack.enter_context(study_folder(out, KIND, settings))
            scratch = out
        records = _evaluate_all(plan.pairs, settings, scratch, out, step)
        study = _study(plan, settings, protocol, records)
        if out is None:
            return StudyOutcome(study)

        def draw() -> Drawn:
            step("drawing charts")
            return draw_here(lambda: draw_charts(study, out))

        texts = {CSV: evaluate_csv(study), MEANS: means_csv(study), LATEX: evaluate_latex(study)}
        draw_chart = draw if figures else None
        outcome = publish(out, KIND, study, texts, draw_chart, partial(article, study), study.provenance)
        step("writing the pages of the pairs")
        _write_pair_pages(out, study, records)
        return outcome


def _with_named_thresholds(settings: EvaluateSettings) -> tuple[BenchmarkProtocol, EvaluateSettings]:
    """Return the protocol with the thresholds of metrics and columns such as `fscore@0.05`, and settings to match.

    Raises:
        InputError: a metric has a threshold, but the protocol has no setting `thresholds`.
    """
    protocol: Any = parse_protocol(settings.protocol)
    metrics, thresholds = split_thresholds(settings.metrics)
    if not hasattr(protocol, "thresholds"):
        if thresholds:
            named = f"fscore@{thresholds[0]:g}"
            raise InputError(f"expected a protocol with thresholds for {named}, such as pcbench, got {protocol.name}")
        return protocol, settings
    thresholds += split_thresholds(settings.columns)[1]
    if added := tuple(value for value in dict.fromkeys(thresholds) if value not in protocol.thresholds):
        protocol = replace(protocol, thresholds=(*protocol.thresholds, *added))
        settings = replace(settings, protocol=protocol_text(protocol))
    return protocol, replace(settings, metrics=metrics)


def _evaluate_all(
    pairs: Sequence[PlannedPair],
    settings: EvaluateSettings,
    scratch: Path,
    out: Path | None,
    step: Callable[[str], None],
) -> list[PairRecord]:
    data = None if settings.protocol_data is None else Path(settings.protocol_data).absolute()
    stored = None if out is None else out.absolute()  # workers of a cluster have other folders
    metrics = tuple(OwnMetric.of(metric).text for metric in check_metrics(settings.metrics))
    shared = shared_settings(stored, settings.protocol, data, settings.seed, metrics)
    if len(pairs) == 1 and settings.cluster is None:
        record = evaluate_alone(shared, pairs[0], step)
        check_columns(settings.columns, record)
        return [record]
    count = settings.workers
    if count is None and settings.cluster is None:
        count = min(cpu_count(), len(pairs))
    return evaluate_pairs(pairs, shared, scratch, Workers(count, settings.cluster), step, settings.columns)


def shared_settings(
    out: Path | None, protocol: str, data: Path | None, seed: int, metrics: tuple[str, ...] = ()
) -> SharedSettings:
    """Return what all pairs share, with digests of code and of the benchmark's files."""
    if data is not None and not data.is_dir():
        raise InputError(f"{data}: expected the folder with the files of the benchmark")
    state = ""
    if data is not None:
        files = sorted(file for file in data.rglob("*") if file.is_file())
        state = ";".join(f"{file.relative_to(data)} {status_of(file)[:2]}" for file in files)
    code = measuring_code_digest("evaluate", _OWN_MODULES)
    return SharedSettings(out, protocol, data, fingerprint(state), seed, code, metrics)


def check_inputs(pairs: Iterable[PlannedPair], settings: EvaluateSettings, out: Path | None) -> None:
    """Check that no input is inside the output folder, where results may replace it.

    The output is not inside the folder of the benchmark either: its files would be taken for changes of the benchmark,
    and a later run would evaluate all pairs again.

    Raises:
        InputError: one is.
    """
    if out is None:
        return
    folder = out.resolve()
    data = [] if settings.protocol_data is None else [Path(settings.protocol_data)]
    if any(folder.is_relative_to(path.resolve()) for path in data):
        raise InputError(f"{out}: expected --out outside the folder {data[0]} of the benchmark's data")
    for path in input_files(pairs, settings):
        if path.resolve().is_relative_to(folder):
            raise InputError(f"{path}: the evaluation replaces files in {out}: choose another --out")


def input_files(pairs: Iterable[PlannedPair], settings: EvaluateSettings) -> list[Path]:
    """Return the files and folders that are named for an evaluation, each once; they need not exist."""
    paths = [] if settings.protocol_data is None else [Path(settings.protocol_data)]
    paths += [file for file in map(code_file, settings.metrics) if file is not None]
    for pair in pairs:
        paths += [Path(file) for file in (pair.reference, pair.candidate) if file]
        paths += [*method_files(pair.register), *filter(None, [region_file(pair.crop)])]
    return list(dict.fromkeys(paths))


def _check_method(text: str) -> None:
    """Refuse an unknown method before any work; its file may be missing for some pairs."""
    kind, colon, _ = text.partition(":")
    if not colon or not any(method.startswith(f"{kind}:") for method in METHODS):
        parse_method(text)


def _study(
    plan: EvaluationPlan, settings: EvaluateSettings, protocol: BenchmarkProtocol, records: Sequence[PairRecord]
) -> MethodComparison:
    pairs = tuple(record.pair for record in records)
    columns = _all_columns(records)
    names = [column.name for column in columns]
    notes = list(plan.notes)
    if columns:
        notes += [f"no pair has the score {name!r}" for name in settings.columns if name not in names]
    settings = replace(settings, columns=tuple(name for name in settings.columns if name in names))
    info = ProtocolInfo(
        protocol_text(protocol), protocol.title, protocol.citation, protocol.version, _setting_texts(protocol)
    )
    methods = tuple(dict.fromkeys(pair.method for pair in pairs))
    study = MethodComparison(
        settings=settings,
        protocol=info,
        columns=columns,
        scenes=tuple(dict.fromkeys(pair.scene for pair in pairs)),
        methods=methods,
        pairs=pairs,
        means=means_over_scenes(columns, methods, pairs, settings.seed),
        level=LEVEL,
        provenance=provenance(settings.seed),
    )
    sentences = (*answer(study), *matched_methods(plan.matched_methods))
    return replace(study, sentences=sentences, warnings=tuple(warnings(study, notes)))


def _setting_texts(protocol: BenchmarkProtocol) -> dict[str, str]:
    """Return all settings of a protocol as they are written in its name."""
    values: dict[str, object] = asdict(protocol)  # type: ignore[call-overload]
    return {name: _setting_text(value) for name, value in values.items()}


def _setting_text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return "/".join(map(str, value)) or "none" if isinstance(value, tuple) else str(value)


def _all_columns(records: Iterable[PairRecord]) -> tuple[ScoreColumn, ...]:
    """Return the scores of all pairs, each once; a unit that differs between pairs is left out."""
    columns: dict[str, ScoreColumn] = {}
    for record in records:
        for column in record.columns:
            known_column = columns.setdefault(column.name, column)
            if known_column.unit != column.unit:
                columns[column.name] = replace(known_column, unit="")
    return tuple(columns.values())


def _write_pair_pages(out: Path, study: MethodComparison, records: Iterable[PairRecord]) -> None:
    """Write the page of each pair beside its evaluation.json; one that fails is left out, as are links to it."""
    origin = Origin(study.provenance)
    for record in records:
        folder = out / record.pair.folder
        page = partial(pair_article, record, study.protocol.title, f"../../{PAGE}")
        write_page(folder / PAGE, lambda page=page, folder=folder: article_page(page(), origin, folder))  # type: ignore[misc]
