"""Conclusions of the experiment as sentences, computed from the results alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from pcbench.deformation import Deformation, Trend
from pcbench.measure.wording import ratio_in_words
from pcbench.report.words import join_words, length
from pcbench.studies.gao.plan import FIELD, MEANS, MVS, SPARSE, SURFACE
from pcbench.studies.gao.results import TRUTH, GaoStudy, InjectedDeformation, ReferenceEvaluation, SceneResult
from pcbench.studies.gao.table import failures

_MIN_RATIO = 1.1  # between lengths that count as different
_BENT_VERDICT = "non-affine"

Length = Callable[[ReferenceEvaluation], float | None]


def sentences(study: GaoStudy) -> Iterator[str]:
    """Yield all conclusions as sentences.

    They cover the gains and costs of densification, the errors that a reference of the same images hides, deformations
    and their causes, and the limits of the results.
    """
    yield from failures(study)
    yield from answer(study)
    yield from warnings(study)


def answer(study: GaoStudy) -> Iterator[str]:
    """Yield the conclusions, without failures and limits of the results."""
    yield from _completeness_sentences(study)
    yield from _accuracy_sentences(study)
    yield from _surface_sentences(study)
    yield from _time_sentences(study)
    yield from _truth_sentences(study)
    yield from _view_sentences(study)
    for scene in study.scenes:
        yield from _deformation_sentences(scene, study)
    yield from _injection_sentences(study)


def _r2c_rms(of: ReferenceEvaluation) -> float | None:
    return of.r2c_rms


def _c2r_rms(of: ReferenceEvaluation) -> float | None:
    return of.c2r_rms


def _completeness_sentences(study: GaoStudy) -> Iterator[str]:
    """Yield sentences on completeness: distances from the reference to the clouds."""
    counts = [(s.cloud(SPARSE).points, s.cloud(MEANS).points) for s in study.scenes]
    both = [(sparse, means) for sparse, means in counts if sparse and means]
    if both:
        sparse, means = (sum(pair[k] for pair in both) for k in (0, 1))
        if means > sparse:
            yield f"Densification increases {sparse:,} points to {means:,} ({ratio_in_words(means / sparse, 'many')})."
        else:
            yield (
                f"Training adds no points ({sparse:,} sparse points, {means:,} splats): what follows is not an effect"
                " of densification, which needs more steps."
            )
    for reference, it, found in _densification_changes(study, _r2c_rms):
        word = found.word("loses completeness", "gains no completeness", "gains completeness")
        yield f"{it} {word}: {reference} to cloud (r→c), {found.text}."


def _accuracy_sentences(study: GaoStudy) -> Iterator[str]:
    """Yield sentences on accuracy: distances from the clouds to the reference."""
    for reference, it, found in _densification_changes(study, _c2r_rms):
        word = found.word("costs accuracy", "costs no accuracy", "gains accuracy")
        yield f"{it} {word}: cloud to {reference} (c→r), {found.text}."


def _densification_changes(study: GaoStudy, rms: Length) -> Iterator[tuple[str, str, _LengthChange]]:
    """Yield the change by densification against each reference, with the start of its sentence."""
    for reference, it in ((MVS, "It"), (TRUTH, "Against the truth it")):
        if (found := _LengthChange.between(study, (SPARSE, reference), (MEANS, reference), rms)) is not None:
            yield reference, it, found


def _surface_sentences(study: GaoStudy) -> Iterator[str]:
    """Yield a sentence that compares the two clouds of the same training."""
    reference = TRUTH if any(scene.has_truth for scene in study.scenes) else MVS
    forth = _LengthChange.between(study, (MEANS, reference), (SURFACE, reference), _c2r_rms)
    back = _LengthChange.between(study, (MEANS, reference), (SURFACE, reference), _r2c_rms)
    if forth is not None and back is not None:
        yield (
            f"The surface of the Gaussians, compared with their centres, against {reference}:"
            f" c→r {forth.text}; r→c {back.text}."
        )


def _time_sentences(study: GaoStudy) -> Iterator[str]:
    """Yield a sentence on time and memory, compared with the dense reference."""
    rows = [[scene.cloud(name) for name in (SPARSE, MVS, MEANS)] for scene in study.scenes]
    whole = [row for row in rows if all(cloud.seconds is not None and not cloud.resumed for cloud in row)]
    if not whole:
        return
    sparse, mvs, means = (_geometric_mean([row[k].seconds or 0.0 for row in whole]) for k in range(3))
    memory = [max((row[k].memory_bytes or 0) for row in whole) / 2**20 for k in range(3)]
    yield (
        f"Time per scene: {sparse:.0f} s for sparse, {mvs:.0f} s more for mvs, {means:.0f} s more for splats"
        f" ({means / mvs:.2g} times mvs); peak memory: {memory[0]:,.0f}, {memory[1]:,.0f} and {memory[2]:,.0f} MiB."
    )
    if any(cloud.beside_others for row in whole for cloud in row):
        yield (
            "Clouds were made with one thread, and other scenes beside them (--workers): do not compare these times"
            " with those of scenes alone."
        )


def _truth_sentences(study: GaoStudy) -> Iterator[str]:
    """Yield sentences on the errors that mvs as the reference hides, if the truth is known."""
    own = [of for scene in study.scenes if (of := scene.evaluation(MVS, TRUTH)) is not None]
    if not own:
        yield (
            "The truth is unknown, so errors that clouds share with mvs (made of the same images and cameras) stay"
            " hidden: the results do not show how accurate or complete mvs is, or whether the cameras deform all clouds"
            " alike."
        )
        return
    forth, back = (
        _geometric_mean([value for of in own if (value := rms(of)) is not None]) for rms in (_c2r_rms, _r2c_rms)
    )
    yield (
        "A reference made of the same images hides its own errors: mvs deviates from the truth by"
        f" {length(forth, study.unit)} RMS (c→r), and the visible truth from mvs by {length(back, study.unit)} RMS"
        " (r→c)."
    )
    for name in (SPARSE, MEANS, SURFACE, FIELD):
        found = _LengthChange.between(study, (name, MVS), (name, TRUTH), _c2r_rms)
        if found is not None:
            word = found.word("worse than against mvs", "as accurate as against mvs", "better than against mvs")
            yield f"Against the truth {name} is {word}: c→r {found.text}."
    by = {reference: _chamfer_order(study, reference) for reference in (MVS, TRUTH)}
    if by[MVS] and by[TRUTH]:
        same = "the same" if by[MVS] == by[TRUTH] else "a different"
        of_mvs = _chamfer_order(study, TRUTH, [MVS, *by[TRUTH]])
        yield (
            f"By Chamfer distance, the order against mvs is {_ranking(by[MVS])}; the truth gives {same} order;"
            f" including mvs: {_ranking(of_mvs)}."
        )


def _chamfer_order(
    study: GaoStudy, reference: str, names: Sequence[str] = (SPARSE, MEANS, SURFACE, FIELD)
) -> list[str]:
    """Rank clouds by their Chamfer distance, best first: geometric means over the scenes that have all of them.

    A cloud that no scene has is left out.
    """
    names = [name for name in names if any(scene.evaluation(name, reference) for scene in study.scenes)]
    rows = [[scene.evaluation(name, reference) for name in names] for scene in study.scenes]
    chamfers = [[of.measures.chamfer for of in row if of is not None and of.measures is not None] for row in rows]
    whole = [row for row in chamfers if len(row) == len(names)]
    if not whole or not names:
        return []
    means = [_geometric_mean([row[k] for row in whole]) for k in range(len(names))]
    return [name for _, name in sorted(zip(means, names, strict=True))]


def _ranking(names: Sequence[str]) -> str:
    return " before ".join(names)


def _view_sentences(study: GaoStudy) -> Iterator[str]:
    """Yield a sentence on the PSNR of held-out and training views."""
    rows = [scene.views for scene in study.scenes if scene.views is not None]
    pairs = [(row.train, row.test) for row in rows if row.train is not None and row.test is not None]
    if pairs:
        train, test = (sum(pair[k].psnr for pair in pairs) / len(pairs) for k in (0, 1))
        yield (
            f"Held-out views are rendered at {test:.1f} dB PSNR, training views at {train:.1f} dB: a gap of"
            f" {train - test:.1f} dB."
        )


def _deformation_sentences(scene: SceneResult, study: GaoStudy) -> Iterator[str]:
    """Yield sentences on deformations, their trends and their possible causes."""
    lead = f"{scene.name}: " if len(study.scenes) > 1 else ""
    for reference in (MVS, TRUTH):
        found = {c.name: of.deformation for c in scene.clouds if (of := c.evaluation(reference)) and of.deformation}
        if found:
            yield f"{lead}against {reference}, {_verdicts(found, scene.unit or '')}."
    for text in _cause_sentences(scene, study):
        yield f"{lead}{text}"


def _verdicts(found: dict[str, Deformation], unit: str) -> str:
    parts = [
        f"{name} is deformed by {_size_text(bend, unit)}"
        for name, bend in found.items()
        if bend.verdict == _BENT_VERDICT
    ]
    for verdict, words in (
        ("affine", "stretched, but not deformed beyond affine"),
        ("similarity", "scaled, but not deformed"),
        ("none", "not deformed"),
    ):
        names = [name for name, bend in found.items() if bend.verdict == verdict]
        if names:
            parts.append(f"{join_words(names)} {'is' if len(names) == 1 else 'are'} {words}")
    reasons: dict[str, list[str]] = {}
    for name, bend in found.items():
        if bend.conditional_verdict is None and bend.verdict == "undecided":
            reasons.setdefault(str(bend.warnings[0]) if bend.warnings else "", []).append(name)
    assumed = {name: bend.assuming_pose() for name, bend in found.items() if bend.conditional_verdict is not None}
    if assumed:
        poses = "its pose is" if len(assumed) == 1 else "their poses are"
        parts.append(f"if {poses} right, {_verdicts(assumed, unit)}")
    parts += [f"{join_words(names)}: undecided{f' ({why})' if why else ''}" for why, names in reasons.items()]
    return "; ".join(parts)


def _size_text(bend: Deformation, unit: str) -> str:
    size, growth = bend.amplitude, bend.growth
    text = "an unknown size"
    if size is not None:
        low, high = size.ci
        text = f"{size.rms:.2g} [{low:.2g}, {high:.2g}] {unit}".rstrip() + " RMS"
    if growth is None:
        return text
    trends = [("distance", growth.with_distance), ("height", growth.with_height)]
    grown = [f"{_slope_text(trend)} with {what}" for what, trend in trends if trend is not None and _is_trend(trend)]
    return f"{text} ({' and '.join(grown)})" if grown else f"{text} (no trend with distance or height)"


def _is_trend(trend: Trend) -> bool:
    return trend.ci[0] > 0 or trend.ci[1] < 0


def _slope_text(trend: Trend) -> str:
    return f"{'rising' if trend.slope > 0 else 'sinking'} by {1000 * abs(trend.slope):.2g} ‰"


def _cause_sentences(scene: SceneResult, study: GaoStudy) -> Iterator[str]:
    """Yield sentences on the causes of deformations.

    Cameras that clouds share do not deform one against another. Their effect against the truth is computed if the truth
    is known.
    """
    yield from _camera_sentences(scene)
    names = [cloud.name for cloud in scene.clouds]
    against_mvs = [name for name in names if _is_bent(scene, name, MVS)]
    if against_mvs:
        yield (
            f"{join_words([*against_mvs, MVS])} use the same cameras, so the cameras do not explain the deformation of"
            f" {join_words(against_mvs)} against mvs{_attribution(scene, against_mvs)}."
        )
    bent = [name for name in names if _is_bent(scene, name, TRUTH)]
    surface = None if scene.cameras is None else scene.cameras.surface
    own = 0.0 if study.poses == "given" else None if surface is None else surface.bent
    if not bent or own is None:
        return
    explained = [name for name in bent if own >= _lower_bound(scene, name)]
    rest = [name for name in bent if name not in explained]
    if explained:
        unseen = [name for name in explained if name != MVS and not _is_bent(scene, name, MVS)]
        hidden = f"; mvs as the reference hides that of {join_words(unseen)}" if unseen else ""
        yield (
            f"the deformation of {join_words(explained)} against the truth does not exceed the effect of the"
            f" cameras{hidden}."
        )
    if rest:
        yield (
            f"the deformation of {join_words(rest)} against the truth exceeds the effect of the cameras: the method"
            " adds to it, or noise that its interval does not include."
        )


def _camera_sentences(scene: SceneResult) -> Iterator[str]:
    """Yield a sentence on the errors of solved cameras and the deformation that they cause."""
    errors = scene.cameras
    if errors is None:
        return
    # Without a truth, the scene's cameras may be as wrong as the solved ones.
    what = "position errors of solved cameras" if scene.has_truth else "distances of solved cameras from the scene's"
    text = (
        f"{what}: {length(errors.median, scene.unit)} (median),"
        f" {length(errors.largest, scene.unit)} (largest); focal length {errors.focal_ratio:.4f} times the scene's"
    )
    cameras = "the cameras"
    if errors.astray:
        cameras = "the other cameras"
        text += f"; {errors.astray} of {errors.solved} {'is an outlier' if errors.astray == 1 else 'are outliers'}"
    if (surface := errors.surface) is not None:
        text += (
            f"; alone, {cameras} deform the surface of all clouds by {length(surface.moved, scene.unit)} RMS beyond a"
            f" rigid motion, and by {length(surface.bent, scene.unit)} RMS beyond an affine one"
        )
    yield f"{text}."


def _verdict(scene: SceneResult, name: str, reference: str) -> str | None:
    of = scene.evaluation(name, reference)
    return None if of is None or of.deformation is None else of.deformation.verdict


def _is_bent(scene: SceneResult, name: str, reference: str) -> bool:
    return _verdict(scene, name, reference) == _BENT_VERDICT


def _lower_bound(scene: SceneResult, name: str) -> float:
    """Return the lower end of the 95 % interval of a cloud's deformation against the truth."""
    of = scene.evaluation(name, TRUTH)
    assert of is not None and of.deformation is not None
    size = of.deformation.amplitude
    return 0.0 if size is None else size.ci[0]


def _attribution(scene: SceneResult, names: Sequence[str]) -> str:
    """Return which of two clouds is deformed if their deformation is relative, as far as the truth shows."""
    if not scene.has_truth:
        return "; without a truth, a deformation of both by the cameras cannot be detected"
    words = []
    straight = _verdict(scene, MVS, TRUTH) in ("none", "similarity", "affine")
    for name in names:
        if _is_bent(scene, name, TRUTH) and straight:
            words.append(f"against the truth {name} is deformed and mvs is not")
        elif _is_bent(scene, MVS, TRUTH) and not _is_bent(scene, name, TRUTH):
            words.append(f"against the truth mvs is deformed, and no deformation of {name} is found")
    return f"; {'; '.join(words)}" if words else "; the truth does not show which of the two is deformed"


def _injection_sentences(study: GaoStudy) -> Iterator[str]:
    """Yield a sentence on deformations of known size: how many are found and attributed to the right cloud."""
    of_size: dict[str, list[InjectedDeformation]] = {}
    for scene in study.scenes:
        for each in scene.injected:
            of_size.setdefault(f"{each.rms:.2g} {study.unit}".strip(), []).append(each)
    if not of_size:
        return
    parts = []
    for size, group in of_size.items():
        found = sum(each.is_found for each in group)
        right = sum(each.attributed == each.cloud for each in group)
        wrong = sum(each.attributed not in (None, each.cloud) for each in group)
        parts.append(f"of {size} RMS, {found} of {len(group)} are found, {right} attributed right, {wrong} wrong")
    yield (
        "Deformations that grow with distance and height, added to one cloud or to mvs at a time and searched for"
        f" without the truth: {'; '.join(parts)}."
    )


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


class _LengthChange:
    """Change of a length between two cases: geometric means over the scenes that have both."""

    def __init__(self, pairs: Sequence[tuple[float, float]], unit: str) -> None:
        self.before, self.after = (_geometric_mean([pair[k] for pair in pairs]) for k in (0, 1))
        self._ratios, self._unit = [after / before for before, after in pairs], unit

    @classmethod
    def between(
        cls, study: GaoStudy, before: tuple[str, str], after: tuple[str, str], rms: Length
    ) -> _LengthChange | None:
        """Compare one cloud and reference with another; None if no scene has both."""
        pairs = []
        for scene in study.scenes:
            of = [scene.evaluation(*which) for which in (before, after)]
            values = [rms(one) for one in of if one is not None]
            if len(values) == 2 and values[0] and values[1]:
                pairs.append((values[0], values[1]))
        return cls(pairs, study.unit) if pairs else None

    @property
    def ratio(self) -> float:
        return self.after / self.before

    def word(self, more: str, same: str, less: str) -> str:
        """Select the word for a longer, an equal or a shorter length."""
        return more if self.ratio > _MIN_RATIO else less if self.ratio < 1 / _MIN_RATIO else same

    @property
    def text(self) -> str:
        """Both lengths, their ratio, and the number of scenes that agree in direction, as text."""
        ratio = self.ratio
        change = f"{ratio:.2g} times as large" if ratio >= 1 else f"{1 / ratio:.2g} times smaller"
        if abs(math.log(ratio)) < math.log(_MIN_RATIO):
            change = "about the same"
        same = sum((value > 1) == (ratio > 1) for value in self._ratios)
        count = f", in {same} of {len(self._ratios)} scenes" if len(self._ratios) > 1 else ""
        return f"{length(self.before, self._unit)} RMS becomes {length(self.after, self._unit)} ({change}{count})"


def _geometric_mean(values: Sequence[float]) -> float:
    """Geometric mean of positive values."""
    return math.exp(sum(math.log(max(value, 1e-300)) for value in values) / len(values))
