"""The budget of D2 and the changes of a candidate in words."""

from __future__ import annotations

from collections.abc import Sequence

from pcbench.changes import ADDED, REMOVED, Change
from pcbench.measure.budget import PARTS
from pcbench.measure.results import Candidate
from pcbench.measure.wording import pluralize
from pcbench.report.moved import MIN_VERTICAL_SHARE
from pcbench.report.words import area, join_words, length, percentage, position_text

_MIN_NAMED_SHARE = 0.045  # of D2, for a part that the answer names: rounded, 5 %
_MAX_NAMED_CHANGES = 3
_MAX_EVEN_RATIO = 1.5  # of the largest offset to the mean one, up to which a part moved as a whole


def source_words(candidate: Candidate, part: str) -> str:
    """Return where a part of D2 comes from, as the object of "comes from"."""
    budget = candidate.budget
    changed = "a change" if budget is not None and len(budget.accuracy.of_changes) == 1 else "changes"
    is_kept = budget is not None and budget.keeps_pose
    return {
        "unmatched": "points without a counterpart",
        "changed": changed,
        "motion": "a motion (the pose was kept)" if is_kept else "a motion that registration left",
        "affine": "a stretch or shear",
        "smooth": "a bend" if candidate.deformation.verdict == "non-affine" else "smooth differences",
        "noise": "noise",
        "unexplained": "outliers, edges or uneven errors",
    }[part]


def largest_part(candidate: Candidate) -> tuple[str, float]:
    """Return the largest part of D2 c→r besides noise and its share; the candidate has a budget."""
    assert candidate.budget is not None
    budget = candidate.budget.accuracy
    name = max((part for part in PARTS if part != "noise"), key=budget.share)
    return name, budget.share(name)


def budget_sentence(candidate: Candidate) -> str:
    """Return the largest parts of D2 c→r in one sentence; empty without a budget."""
    if candidate.budget is None:
        return ""
    budget = candidate.budget.accuracy
    sources = [name for name in PARTS if name not in ("noise", "unexplained")]
    order = [*sorted(sources, key=budget.share, reverse=True), "noise"]
    named = [name for name in order if budget.share(name) >= _MIN_NAMED_SHARE]
    clauses = []
    if named:
        parts = [f"from {source_words(candidate, name)}" for name in named]
        parts[0] = f"comes {parts[0]}"
        shares = [percentage(budget.share(name)) for name in named]
        clauses.append(join_words([f"{share} {part}" for share, part in zip(shares, parts, strict=True)]))
    if budget.share("unexplained") >= _MIN_NAMED_SHARE:
        clauses.append(f"{percentage(budget.share('unexplained'))} is unexplained (outliers, edges or uneven errors)")
    return f"Of its mean square, {'; '.join(clauses)}." if clauses else ""


def changes_sentence(changes: Sequence[Change], unit: str | None) -> str:
    """Return the most important changes in one sentence without a subject: "2 parts changed: ..."."""
    words = [change_words(change, unit) for change in changes[:_MAX_NAMED_CHANGES]]
    unnamed = len(changes) - len(words)
    ending = f"; and {unnamed:,} more" if unnamed > 0 else ""
    return f"{pluralize(len(changes), 'part')} changed: {'; '.join(words)}{ending}."


def changes_of(candidate: Candidate) -> Sequence[Change]:
    """Return the changes of a candidate; none if they were not searched for."""
    return () if candidate.changes is None else candidate.changes.found


def change_words(change: Change, unit: str | None) -> str:
    """Return what happened to a part, where, and its area: "raised by 0.31 m at (1.0, 2.0, 0.5), 12.4 m²"."""
    return f"{kind_words(change, unit)} at {position_text(change.place)}, {area(change.area, unit)}"


def kind_words(change: Change, unit: str | None) -> str:
    """Return what happened to a part: added, removed, raised, lowered or moved, and by how much."""
    if change.kind in (ADDED, REMOVED):
        return change.kind if change.peak is None else f"{change.kind} (up to {length(abs(change.peak), unit)} off)"
    if change.motion is not None:
        distance = sum(x * x for x in change.motion) ** 0.5
        if abs(change.motion[2]) < MIN_VERTICAL_SHARE * distance:
            return f"moved by {length(distance, unit)}"
        rise = abs(change.motion[2])
        words = f"{'raised' if change.motion[2] > 0 else 'lowered'} by {length(rise, unit)}"
        is_uneven = change.peak is not None and abs(change.peak) > _MAX_EVEN_RATIO * rise
        return f"{words} on average, by up to {length(abs(change.peak or 0.0), unit)}" if is_uneven else words
    if change.mean is None:
        return change.kind
    return f"moved by {length(abs(change.mean), unit)} along the normals"
