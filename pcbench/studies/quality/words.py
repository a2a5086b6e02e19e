"""The quality of a cloud in sentences: what matters first, and what was looked for and not found."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from pcbench.measure.quality.numbers import QualityNumber, have_equal_density
from pcbench.measure.wording import pluralize, with_unit
from pcbench.report.words import join_words, length, length_number, percentage
from pcbench.studies.quality.results import MeasuredCloud

_MIN_FILLED_SHARE = 0.9  # of the specification
_MIN_OUTLIER_SHARE = 1e-4  # below which outliers are not in the answer
_MIN_TILT_DEG = 0.1
_COARSE_STEP_SHARE = 1.0  # of the noise: a larger step is most of the noise
_MIN_FLAT_SHARE = 0.3  # below which the noise is that of few places


def answer(measured: MeasuredCloud) -> list[str]:
    """Return three to six sentences on the quality of a cloud, the most important one first."""
    parts = [
        *_noise(measured),
        *_double_walls(measured),
        *_strips(measured),
        *_voids(measured),
        *_points(measured),
        *_tilt(measured),
        *_rounding(measured),
        *_density(measured),
    ]
    return parts


def named_answer(measured: MeasuredCloud) -> list[str]:
    """Return the answer about one of two clouds, whose name is in each sentence."""
    first, *others = answer(measured)
    return [first, *(f"{measured.name}: {text[0].lower()}{text[1:]}" for text in others)]


def comparison(first: MeasuredCloud, second: MeasuredCloud, better: Mapping[str, int | None]) -> list[str]:
    """Return in which numbers each of two clouds is better, in sentences."""
    texts = []
    for place, cloud, other in ((1, first, second), (2, second, first)):
        names = [name for name, which in better.items() if which == place]
        if names:
            listed = join_words([_difference(name, cloud.numbers, other.numbers) for name in names], 6)
            texts.append(f"{cloud.name} is better in {listed}.")
    alike = [first.numbers[name].label for name, which in better.items() if which == 0 and first.value(name) != 0]
    if alike:
        texts.append(f"No more than chance explains: {join_words(alike, 8)}.")
    if not have_equal_density(dict(first.numbers), dict(second.numbers)):
        texts.append(
            "Mean map entropy and mean plane variance are not compared, because the spacings of the clouds differ by"
            " more than 20 %: thin the denser one."
        )
    return texts


def value_text(number: QualityNumber) -> str:
    """Return a number with its interval and unit, such as "0.012 [0.011, 0.013] m"; a dash if there is none."""
    if number.value is None:
        return "–"
    if number.is_count and number.unit == "" and number.value == int(number.value):
        return f"{int(number.value):,}"
    text = f"{int(number.value):,}" if number.label in ("points", "walls") else length_number(number.value)
    if number.low is not None and number.high is not None:
        text += f" {interval_text(number.low, number.high)}"
    return with_unit(text, number.unit)


def interval_text(low: float, high: float) -> str:
    """Return the ends of an interval in brackets, as lengths are written."""
    return f"[{length_number(low)}, {length_number(high)}]"


def _difference(name: str, numbers: Mapping[str, QualityNumber], others: Mapping[str, QualityNumber]) -> str:
    number, other = numbers[name], others[name]
    assert number.value is not None and other.value is not None
    values = f"{length_number(number.value)} against {with_unit(length_number(other.value), number.unit)}"
    return f"{number.label} ({values})"


def _noise(measured: MeasuredCloud) -> Iterator[str]:
    noise, thickness, flat = (measured.numbers[name] for name in ("noise", "thickness", "flat_share"))
    if noise.value is None or thickness.value is None or flat.value is None:
        yield f"The noise of {measured.name} is unknown: {measured.reasons.get('noise', 'it has too few points')}."
        return
    few = ""
    if flat.value < _MIN_FLAT_SHARE:
        few = f", on the {percentage(flat.value)} of the patches that lie on a smooth surface"
    yield (
        f"The points of {measured.name} scatter across surfaces by {value_text(noise)} (noise){few}; 90 % of them lie"
        f" within a thickness of {length(thickness.value, thickness.unit)}."
    )


def _double_walls(measured: MeasuredCloud) -> Iterator[str]:
    count, separation = measured.value("double_wall_count"), measured.numbers["double_wall_separation"]
    if count is None:
        return
    if not count:
        yield f"No double walls: {measured.reasons['double_walls']}."
        return
    area = measured.numbers["double_wall_area"]
    walls = pluralize(int(count), "surface")
    yield (
        f"{walls} {'appears' if count == 1 else 'appear'} twice, as sheets {value_text(separation)} apart"
        f" (double walls, {value_text(area)} in all): drift, scans that do not fit, or thin walls seen from both sides."
    )


def _strips(measured: MeasuredCloud) -> Iterator[str]:
    worst = next((pair for pair in measured.strips if pair.dz is not None), None)
    if worst is None or worst.dz is None or worst.rms_dz is None:
        if measured.strips:
            yield f"Overlapping strips agree to {value_text(measured.numbers['strip_rms'])} along the normals (RMS)."
        return
    is_offset = worst.dz.low > 0 or worst.dz.high < 0
    offset = f"{length_number(worst.dz.value)} {interval_text(worst.dz.low, worst.dz.high)}"
    offset = with_unit(offset, measured.unit or "units")
    pairs = pluralize(len(measured.strips), "overlapping pair")
    rms = length(worst.rms_dz.value, measured.unit or "units")
    if is_offset:
        yield (
            f"Strips {worst.first} and {worst.second} ({measured.strip_field}) differ by {offset} in height, RMSDz"
            f" {rms}{'' if len(measured.strips) == 1 else f'; it is the largest difference of {pairs}'}."
        )
    else:
        yield (
            f"{pairs} of strips ({measured.strip_field}) {'has' if len(measured.strips) == 1 else 'have'} no offset in"
            f" height beyond chance: the largest is {offset}, RMSDz {rms}."
        )


def _voids(measured: MeasuredCloud) -> Iterator[str]:
    count = measured.value("void_count")
    if count is None:
        return
    filled = measured.value("filled_share")
    water = f", beside {pluralize(measured.water_voids, 'void')} at water" if measured.water_voids else ""
    if not count:
        yield f"No voids: {measured.reasons['voids']}{water}."
    else:
        area, largest = measured.value("void_area") or 0.0, measured.value("largest_void") or 0.0
        size = f"{length_number(area)} {measured.unit or 'units'}²"
        if count > 1:
            size += f" in all, the largest {length_number(largest)} {measured.unit or 'units'}²"
        yield f"{pluralize(int(count), 'void')} without returns, {size}{water}."
    if filled is not None and filled < _MIN_FILLED_SHARE:
        yield (
            f"Only {percentage(filled)} of the cells of twice the pulse spacing have a pulse; the USGS Lidar Base"
            " Specification demands 90 %."
        )


def _points(measured: MeasuredCloud) -> Iterator[str]:
    points = measured.value("points") or 0.0
    outliers, copies, missing = (measured.value(name) or 0.0 for name in ("outliers", "copies", "missing_points"))
    if missing:
        yield f"{measured.missing_data[0].upper()}{measured.missing_data[1:]}; they count in no other number."
    parts = []
    if outliers > max(_MIN_OUTLIER_SHARE * points, 0):
        parts.append(f"{pluralize(int(outliers), 'outlier')} ({percentage(outliers / points)})")
    if copies:
        copied = "copy of another point" if copies == 1 else "copies of other points"
        parts.append(f"{int(copies):,} exact {copied} ({percentage(copies / points)})")
    if parts:
        yield f"Of {int(points):,} points: {join_words(parts)}."


def _tilt(measured: MeasuredCloud) -> Iterator[str]:
    tilt = measured.numbers["tilt"]
    if tilt.value is None or tilt.low is None or tilt.high is None:
        return
    if tilt.low >= _MIN_TILT_DEG:
        yield (
            f"The {int(measured.value('wall_count') or 0)} walls lean together by {value_text(tilt)}: the cloud is"
            " rotated against the vertical, or z is not up."
        )


def _rounding(measured: MeasuredCloud) -> Iterator[str]:
    step, noise, single = measured.value("step"), measured.value("noise"), measured.value("float32_step")
    if step and noise is not None and step > _COARSE_STEP_SHARE * noise:
        cause = " (32-bit floats at large coordinates)" if single and 0.4 < step / single < 2.1 else ""
        yield (
            f"Coordinates are rounded to steps of {length(step, measured.unit or 'units')}{cause}, more than the noise:"
            " store them with more digits, or relative to a local origin."
        )


def _factor(ratio: float) -> str:
    """Return a ratio with two significant digits, and without exponent."""
    return f"{float(f'{ratio:.2g}'):,g}"


def _density(measured: MeasuredCloud) -> Iterator[str]:
    spacing, ratio = measured.numbers["spacing"], measured.value("surface_density_ratio")
    pulse, plan = measured.numbers["pulse_density"], measured.numbers["plan_density"]
    if spacing.value is None:
        return
    text = f"The point spacing is {length(spacing.value, spacing.unit)}"
    if measured.value("void_count") is not None:
        chosen = plan if pulse.value is None else pulse
        text += f", the {'pulse ' if pulse.value is not None else ''}density {value_text(chosen)} in plan view"
    if ratio is not None:
        text += f"; the density on the surface varies by a factor of {_factor(ratio)} (5th to 95th percentile)"
    yield f"{text}."
