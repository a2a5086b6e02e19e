"""The accuracy of compared clouds by check points: a sentence, remarks, and a table for the page."""

from __future__ import annotations

from collections.abc import Iterator

from pcbench.measure.checkpoints import CloudAccuracy
from pcbench.measure.results import Candidate
from pcbench.report.checkpoints import caveats, headline, method_sentence, signed
from pcbench.report.inputs import FinishedComparison
from pcbench.report.words import UNKNOWN, length, length_number, printable


def checked_clouds(comparison: FinishedComparison) -> Iterator[tuple[str, CloudAccuracy]]:
    """Yield the name and the accuracy of each cloud: the reference, and each candidate as given and as aligned."""
    if (reference := comparison.reference.check_points) is not None:
        yield "reference", reference
    for candidate in comparison:
        yield from _of_candidate(candidate, f"{printable(candidate.name)} as given")


def check_point_sentences(comparison: FinishedComparison) -> list[str]:
    """Return one sentence on the heights at check points, or none without check points."""
    clouds = [f"{name}: {headline(accuracy)}" for name, accuracy in checked_clouds(comparison)]
    return [f"Heights at check points (cloud minus survey): {'; '.join(clouds)}."] if clouds else []


def check_point_remarks(comparison: FinishedComparison) -> Iterator[str]:
    """Yield how heights were found, and what limits the numbers of each cloud as given."""
    clouds = [(name, accuracy) for name, accuracy in checked_clouds(comparison) if not name.endswith(" aligned")]
    if clouds:
        yield method_sentence(clouds[0][1])
    for name, accuracy in clouds:
        if accuracy.hint:
            yield f"{name}: {accuracy.hint}."
        yield from (f"{name}: {text}" for text in caveats(accuracy))


def check_point_rows(comparison: FinishedComparison) -> list[list[str]]:
    """Return a table with a header and a row for each cloud; only the header without check points."""
    rows = [["cloud", "check points", "bias", "RMSE", "95 % interval", "NMAD", "95 % below"]]
    for name, accuracy in checked_clouds(comparison):
        if accuracy.every is None:
            rows.append([name, "0", *[UNKNOWN] * 5])
            continue
        errors, unit = accuracy.every.errors, accuracy.unit
        interval = " to ".join(length_number(end) for end in errors.rmse_interval)
        lengths = [signed(errors.mean, unit), length(errors.rmse, unit), interval]
        rows.append(
            [name, f"{errors.count:,}", *lengths, length(errors.nmad, unit), length(errors.p95, unit)],
        )
    return rows


def _of_candidate(candidate: Candidate, name: str) -> Iterator[tuple[str, CloudAccuracy]]:
    if candidate.check_points is None:
        return
    yield name, candidate.check_points.as_given
    if candidate.check_points.aligned is not None:
        yield f"{printable(candidate.name)} aligned", candidate.check_points.aligned
