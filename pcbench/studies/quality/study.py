"""Measure the quality of one cloud, or of two side by side, and write the results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import check_heights, check_lengths, single_unit
from pcbench.io.las_records import parse_filters
from pcbench.io.source import Source
from pcbench.measure.quality.numbers import better_cloud, quality_numbers
from pcbench.measure.quality.quality import CloudData, CloudQuality, QualityMaps, default_radius, measure_quality
from pcbench.measure.quality.settings import QualitySettings
from pcbench.measure.wording import with_unit
from pcbench.report.document import provenance
from pcbench.report.figures import Figures, record_figures
from pcbench.report.html import InputRow
from pcbench.report.names import names_of
from pcbench.report.plot import Drawn
from pcbench.studies.frame.folder import check_folder, study_folder
from pcbench.studies.frame.publish import StudyOutcome, draw_here, publish
from pcbench.studies.quality.charts import draw_charts
from pcbench.studies.quality.maps import write_maps
from pcbench.studies.quality.page import article
from pcbench.studies.quality.results import CSV, KIND, MAPS, MeasuredCloud, QualityStudy
from pcbench.studies.quality.table import numbers_csv
from pcbench.studies.quality.words import answer, comparison, named_answer

_BYTES_PER_POINT = 260
"""Peak memory for each point with the attributes of a LAS file, in bytes; measured with 10 million points."""
_BASE_BYTES = 400 << 20
_MOST_LISTED = 100


def run_quality(
    paths: Sequence[Path],
    settings: QualitySettings,
    out: Path | None = None,
    *,
    memory: int,
    figures: Figures | None = None,
    step: Callable[[str], None] = lambda _: None,
) -> StudyOutcome[QualityStudy]:
    """Measure the quality of one cloud, or of two with the same radius.

    Args:
        paths: paths of one or two clouds.
        settings: the settings.
        out: folder for the results; None: nothing is written.
        memory: bytes that may be used.
        figures: appearance of the pictures; None: none are drawn.
        step: called with a short text before each step that takes time.

    Raises:
        InputError: a cloud is not usable or needs more memory, or `out` holds something else.
        OSError: a file cannot be read or written.
    """
    filters = parse_filters(settings.classes, settings.returns)
    sources = [Source.open(path, filters) for path in paths]
    for path in (file for source in sources for file in source.files):
        if out is not None and path.resolve().is_relative_to(out.resolve()):
            raise InputError(f"{path}: the results replace files in {out}: choose another --out")
    if out is not None:
        check_folder(out, KIND)
    clouds = [_read(source, memory // len(sources), step) for source in sources]
    if len(clouds) == 2 and settings.radius is None:
        common = max(default_radius(data, settings) for data, _, _ in clouds)
        settings = replace(settings, radius=common or None)
    measured, maps = [], []
    for source, name, (data, cloud, warnings) in zip(sources, names_of(paths), clouds, strict=True):
        step(f"measuring {source.path}")
        try:
            quality, plans = measure_quality(data, settings, step)
        except InputError as error:
            raise InputError(f"{source.path}: {error}") from error
        measured.append(_summary(source, name, cloud, quality, settings, warnings))
        maps.append(plans)
    study = _study(measured, settings)
    if out is None:
        return StudyOutcome(study)
    return _write(out, study, maps, sources, figures, step)


def _write(
    out: Path,
    study: QualityStudy,
    maps: Sequence[QualityMaps],
    sources: Sequence[Source],
    figures: Figures | None,
    step: Callable[[str], None],
) -> StudyOutcome[QualityStudy]:
    with study_folder(out, KIND, study.settings):
        step("writing maps")
        (out / MAPS).mkdir(exist_ok=True)
        write_maps(out / MAPS, study.clouds, maps)
        if figures is not None:
            record_figures(out / "settings.json", figures)

        def draw() -> Drawn:
            step("drawing maps")
            return draw_here(lambda: draw_charts(out, figures or Figures(), study))

        step("computing digests")
        inputs = [InputRow("cloud", str(source.path), source.digest()) for source in sources]
        drawing = None if figures is None else draw
        texts = {CSV: numbers_csv(study)}
        return publish(out, KIND, study, texts, drawing, partial(article, study), study.provenance, inputs)


def _read(source: Source, memory: int, step: Callable[[str], None]) -> tuple[CloudData, Cloud, tuple[str, ...]]:
    """Read a cloud with what tells its strips apart, and return the warnings of the reader.

    Raises:
        InputError: it is a mesh, needs more memory, or has degrees, geocentric coordinates or mixed units.
    """
    if source.is_mesh_only:
        raise InputError(
            f"{source.path}: expected a cloud, got a mesh: sample it with pcbench convert {source.path} OUT --sample N"
        )
    disk = source.pieces()
    check_heights(disk.crs, str(source.path))
    needed = _BASE_BYTES + disk.count * _BYTES_PER_POINT
    if needed > memory:
        raise InputError(
            f"{source.path}: expected a cloud that fits into --memory, got {disk.count:,} points, which need"
            f" {needed / (1 << 30):.1f} GiB: crop it with pcbench crop,"
            " keep some classes or returns, or give more memory"
        )
    step(f"reading {source.path}")
    warnings: list[str] = []
    cloud = source.read_cloud(warnings.append)
    check_lengths(cloud, str(source.path))
    if cloud.unit is None:
        mixed: list[str] = []
        single_unit(cloud.crs, mixed.append)
        if mixed:
            raise InputError(f"{source.path}: expected one unit of length, got two: {mixed[0]}")
    counts = [file.count for file in disk.files]
    files = None
    if len(counts) > 1 and sum(counts) == len(cloud):  # otherwise filters or missing values removed some
        files = np.repeat(np.arange(1, len(counts) + 1), counts)
    # Missing data have an own sentence, which counts them the same way.
    kept = tuple(line for line in dict.fromkeys(warnings) if "missing data seem to be stored" not in line)
    return CloudData(cloud.points, cloud.attributes, cloud.normals, files), cloud, kept


def _summary(
    source: Source, name: str, cloud: Cloud, quality: CloudQuality, settings: QualitySettings, warnings: tuple[str, ...]
) -> MeasuredCloud:
    strips = quality.strips
    voids = () if quality.voids is None else quality.voids.counted
    return MeasuredCloud(
        cloud=str(source.path),
        name=name,
        crs=cloud.crs,
        unit=cloud.unit,
        numbers=quality_numbers(quality, cloud.unit),
        voids=voids[:_MOST_LISTED],
        water_voids=0 if quality.voids is None else len(quality.voids.voids) - len(voids),
        double_walls=() if quality.double_walls is None else quality.double_walls.walls[:_MOST_LISTED],
        strips=() if strips is None else strips.pairs[:_MOST_LISTED],
        strip_field="none" if strips is None else strips.field,
        reasons=_reasons(quality, cloud.unit, settings),
        missing_data=quality.coordinates.missing_text,
        warnings=warnings,
    )


def _reasons(quality: CloudQuality, unit: str | None, settings: QualitySettings) -> dict[str, str]:
    """Return why parts are missing or empty, by their names."""
    reasons = {}
    if quality.density is None:
        reasons["density"] = "the points cover no area"
    elif quality.density.why_not:
        reasons["voids"] = f"not looked for, because {quality.density.why_not}"
    elif quality.voids is not None and not quality.voids.counted:
        least = f"{quality.voids.least_area:.3g} {unit or 'units'}²"
        reasons["voids"] = f"no area inside the cloud of {least} or more is without returns"
    if quality.surface is None:
        reasons["noise"] = "too few patches of its points lie on a smooth surface"
    if quality.double_walls is not None and not quality.double_walls.walls:
        limit = with_unit(f"{quality.double_walls.max_separation:.3g}", unit or "units")
        reasons["double_walls"] = f"no surface appears twice within {limit}, if it is four times as wide as the gap"
    if quality.entropy is None:
        reasons["entropy"] = f"too few points have {settings.min_neighbors} points around them"
    if quality.strips is not None and quality.strips.why_not:
        reasons["strips"] = quality.strips.why_not
    if quality.upright is not None and quality.upright.why_not:
        reasons["tilt"] = quality.upright.why_not
    return reasons


def _study(measured: Sequence[MeasuredCloud], settings: QualitySettings) -> QualityStudy:
    first, *others = measured
    better: dict[str, int | None] = {}
    sentences = answer(first)
    if others:
        numbers = dict(first.numbers), dict(others[0].numbers)
        better = {name: better_cloud(name, *numbers) for name in numbers[0]}
        sentences = [*comparison(first, others[0], better), *named_answer(first), *named_answer(others[0])]
    return QualityStudy(first, others[0] if others else None, better, tuple(sentences), settings, provenance(None))
