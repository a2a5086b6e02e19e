"""Conclusions of the experiment as sentences, computed from the results alone; the tables have the rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from pcbench.measure.wording import ratio_in_words
from pcbench.report.words import join_words, length
from pcbench.studies.gao.plan import MEANS, MVS, SPARSE
from pcbench.studies.gao.results import TRUTH, GaoStudy, ReferenceEvaluation
from pcbench.studies.gao.table import failures

_MIN_RATIO = 1.1  # between lengths that count as different
_BENT_VERDICT = "non-affine"

Length = Callable[[ReferenceEvaluation], float | None]


def sentences(study: GaoStudy) -> Iterator[str]:
    """Yield failures, the conclusions, and the limits of the results as sentences."""
    yield from failures(study)
    yield from answer(study)
    yield from warnings(study)


def answer(study: GaoStudy) -> Iterator[str]:
    """Yield what densification gains and costs, what a reference of the same images hides, and what is deformed."""
    yield from _densification(study)
    yield from _hidden_errors(study)
    yield from _deformations(study)


def warnings(study: GaoStudy) -> Iterator[str]:
    """Yield sentences on the limits of the results."""
    if any(scene.views is not None for scene in study.scenes):
        yield "Images that were held out of the training of splats were still used by sparse and mvs."
    steps, rules = study.splat.get("steps"), study.splat.get("density")
    if steps is not None and steps.isdigit() and int(steps) < 30_000:
        yield (
            f"Splats were trained for at most {int(steps):,} steps (density={rules}); the paper trains for 30,000 to"
            " 50,000 on larger images."
        )
    if any(cloud.beside_others for scene in study.scenes for cloud in scene.clouds):
        yield (
            "Clouds were made with one thread, and other scenes beside them (--workers): do not compare these times"
            " with those of scenes alone."
        )


def _densification(study: GaoStudy) -> Iterator[str]:
    """Yield how the number of points, completeness and accuracy change from sparse points to the splats' centres."""
    counts = [(scene.cloud(SPARSE).points, scene.cloud(MEANS).points) for scene in study.scenes]
    complete = [(sparse, means) for sparse, means in counts if sparse and means]
    if not complete:
        return
    sparse, means = (sum(pair[k] for pair in complete) for k in (0, 1))
    text = (
        f"Densification increases {sparse:,} points to {means:,} ({ratio_in_words(means / sparse, 'many')})"
        if means > sparse
        else f"Training adds no points ({sparse:,} sparse points, {means:,} splats), so this is not an effect of"
        " densification"
    )
    reference = _judging_reference(study)
    completeness = _LengthChange.of_densification(study, reference, lambda evaluation: evaluation.r2c_rms)
    accuracy = _LengthChange.of_densification(study, reference, lambda evaluation: evaluation.c2r_rms)
    if completeness is None or accuracy is None:
        yield f"{text}."
        return
    gain = completeness.word("loses completeness", "gains no completeness", "gains completeness")
    cost = accuracy.word("costs accuracy", "costs no accuracy", "gains accuracy")
    yield f"{text}: against {reference} it {gain} (r→c: {completeness.text}) and {cost} (c→r: {accuracy.text})."


def _hidden_errors(study: GaoStudy) -> Iterator[str]:
    """Yield the errors that mvs as the reference hides, if the truth is known."""
    own = [evaluation for scene in study.scenes if (evaluation := scene.evaluation(MVS, TRUTH)) is not None]
    if not own:
        yield (
            "The truth is unknown, so errors that clouds share with mvs (made of the same images and cameras) stay"
            " hidden: the results do not show how accurate or complete mvs is, or whether the cameras deform all clouds"
            " alike."
        )
        return
    forth = _geometric_mean([evaluation.c2r_rms for evaluation in own if evaluation.c2r_rms is not None])
    back = _geometric_mean([evaluation.r2c_rms for evaluation in own if evaluation.r2c_rms is not None])
    yield (
        "A reference made of the same images hides its own errors: mvs deviates from the truth by"
        f" {length(forth, study.unit)} RMS (c→r), and the visible truth from mvs by {length(back, study.unit)} RMS"
        " (r→c)."
    )


def _deformations(study: GaoStudy) -> Iterator[str]:
    """Yield the clouds that are deformed beyond an affine motion, with the number of scenes if there are several."""
    reference = _judging_reference(study)
    verdicts: dict[str, list[str]] = {}
    for scene in study.scenes:
        for cloud in scene.clouds:
            if (evaluation := cloud.evaluation(reference)) is not None and evaluation.deformation is not None:
                verdicts.setdefault(cloud.name, []).append(evaluation.deformation.verdict)
    if not verdicts:
        return
    deformed = [
        name if len(study.scenes) == 1 else f"{name} (in {cases.count(_BENT_VERDICT)} of {len(cases)} scenes)"
        for name, cases in verdicts.items()
        if _BENT_VERDICT in cases
    ]
    undecided = sum(cases.count("undecided") for cases in verdicts.values())
    total = sum(map(len, verdicts.values()))
    rest = f"; {undecided} of {total} verdicts are undecided, or hold only if the pose is right" if undecided else ""
    what = f"{join_words(deformed)} {'is' if len(deformed) == 1 else 'are'}" if deformed else "no cloud is"
    yield f"Against {reference}, {what} deformed beyond an affine motion{rest}."


def _judging_reference(study: GaoStudy) -> str:
    """Return the reference that shows most: the truth, if a scene has one."""
    return TRUTH if any(scene.has_truth for scene in study.scenes) else MVS


class _LengthChange:
    """Change of a length between two cases: geometric means over the scenes that have both."""

    def __init__(self, pairs: Sequence[tuple[float, float]], unit: str) -> None:
        self.before, self.after = (_geometric_mean([pair[k] for pair in pairs]) for k in (0, 1))
        self.ratio = self.after / self.before
        self._ratios, self._unit = [after / before for before, after in pairs], unit

    @classmethod
    def of_densification(cls, study: GaoStudy, reference: str, rms: Length) -> _LengthChange | None:
        """Compare sparse points with the splats' centres against a reference; None if no scene has both."""
        pairs = []
        for scene in study.scenes:
            evaluations = [scene.evaluation(name, reference) for name in (SPARSE, MEANS)]
            values = [rms(evaluation) for evaluation in evaluations if evaluation is not None]
            if len(values) == 2 and values[0] and values[1]:
                pairs.append((values[0], values[1]))
        return cls(pairs, study.unit) if pairs else None

    def word(self, more: str, same: str, less: str) -> str:
        """Select the word for a longer, an equal or a shorter length."""
        return more if self.ratio > _MIN_RATIO else less if self.ratio < 1 / _MIN_RATIO else same

    @property
    def text(self) -> str:
        """Both lengths, their ratio, and the number of scenes that agree in direction, as text."""
        change = f"{self.ratio:.2g} times as large" if self.ratio >= 1 else f"{1 / self.ratio:.2g} times smaller"
        if abs(math.log(self.ratio)) < math.log(_MIN_RATIO):
            change = "about the same"
        same = sum((value > 1) == (self.ratio > 1) for value in self._ratios)
        count = f", in {same} of {len(self._ratios)} scenes" if len(self._ratios) > 1 else ""
        return f"{length(self.before, self._unit)} RMS becomes {length(self.after, self._unit)}, {change}{count}"


def _geometric_mean(values: Sequence[float]) -> float:
    """Geometric mean of positive values."""
    return math.exp(sum(math.log(max(value, 1e-300)) for value in values) / len(values))
