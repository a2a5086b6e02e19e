"""Units of length: their names and their lengths in metres."""

from __future__ import annotations

from pcbench.errors import InputError

_METRES_PER_UNIT = {
    **dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("mm", "millimetre", "millimeter", "millimetres", "millimeters"), 1e-3),
    **dict.fromkeys(("cm", "centimetre", "centimeter", "centimetres", "centimeters"), 1e-2),
    **dict.fromkeys(("km", "kilometre", "kilometer", "kilometres", "kilometers"), 1e3),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
    **dict.fromkeys(("us-ft", "us survey foot", "foot_us", "ftus"), 1200 / 3937),
    **dict.fromkeys(("in", "inch", "inches"), 0.0254),
}
_SHORT_NAMES = {1.0: "m", 0.3048: "ft", 0.3048006096: "US-ft", 1e-3: "mm", 1e-2: "cm", 1e3: "km", 0.0254: "in"}
_DEGREE_UNITS = ("deg", "degree", "degrees", "°")


def metres(unit: str | None) -> float | None:
    """Return the length of a unit in metres; None if it is unknown."""
    return _METRES_PER_UNIT.get((unit or "").strip().lower())


def unit_key(unit: str) -> float | str:
    """Return a key that is the same for all names of one unit."""
    return metres(unit) or unit.strip().lower()


def unit_of_length(length: float) -> str | None:
    """Return the short name of the unit of a length in metres, which files round; None if there is none."""
    return _SHORT_NAMES.get(round(length, 10))


def check_unit_option(unit: str | None) -> None:
    """Check a unit that the user states with --unit.

    Raises:
        InputError: it is no unit of length.
    """
    if unit is not None and metres(unit) is None:
        raise InputError(f"expected --unit as a unit of length, such as m, ft or US-ft, got {unit!r}")


def unit_or_given(stated: str | None, given: str | None, name: str) -> str | None:
    """Return the unit that a cloud states, or else the one given with --unit; None if there is neither.

    Args:
        stated: unit that the cloud states.
        given: unit of length that the user states.
        name: path of the cloud, for the message.

    Raises:
        InputError: the two are different.
    """
    length = metres(given)
    if length is None:
        return stated
    if stated is None:
        return unit_of_length(length) or given
    if metres(stated) != length:
        raise InputError(f"{name}: the cloud states the unit {stated}: omit --unit {given}")
    return stated


def is_degree(unit: str | None) -> bool:
    """Return whether a unit is the degree."""
    return (unit or "").strip().lower() in _DEGREE_UNITS


def check_same_unit(reference: str | None, candidate: str | None) -> None:
    """Check that two clouds that are measured in the given coordinates do not state different units.

    Raises:
        InputError: both state a unit of length, and these differ.
    """
    lengths = metres(reference), metres(candidate)
    if None not in lengths and lengths[0] != lengths[1]:
        raise InputError(
            f"expected the candidate in {reference} as the reference, got {candidate}: convert it with pcbench convert"
            f" FILE OUT --to-unit {reference}"
        )
