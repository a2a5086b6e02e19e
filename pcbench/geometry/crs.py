"""Coordinate reference systems as files name them: WKT or an authority code."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from pcbench.errors import MissingExtra
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import fit_similarity

_MAX_LINE = 100


def same_crs(first: str, second: str) -> bool:
    """Whether two names mean one system; without pyproj only equal texts do."""
    if first == second:
        return True
    a, b = _parsed(first), _parsed(second)
    return a is not None and b is not None and bool(a.equals(b, ignore_axis_order=True))


def crs_name(text: str) -> str:
    """A short name for messages: the authority code or the system's own name."""
    crs = _parsed(text)
    if crs is None:
        return text if len(text) <= 40 else f"{text[:37]}..."
    authority = crs.to_authority(min_confidence=100)
    return ":".join(authority) if authority else str(crs.name)


def crs_line(text: str) -> str:
    """A system for people: its name and, where there is one, its authority code, in one line of at most 100 letters.

    Without pyproj the name that WKT begins with, else the text itself, is all that is known.
    """
    crs = _parsed(text)
    if crs is not None:
        code = crs.to_authority(min_confidence=100)
        line = f"{crs.name} ({':'.join(code)})" if code else str(crs.name)
    else:
        quoted = re.match(r'\s*\w+\s*\[\s*"([^"]+)"', text)
        line = quoted[1] if quoted else text
    line = " ".join(line.split())
    return line if len(line) <= _MAX_LINE else f"{line[: _MAX_LINE - 3]}..."


def is_known(text: str | None) -> bool:
    """Whether pyproj is installed and knows this system."""
    return text is not None and _parsed(text) is not None


def has_heights(text: str | None) -> bool:
    """Return whether a system is a map grid, alone or with a system of heights, so that z is known to be height."""
    crs = None if text is None else _parsed(text)
    if crs is None:
        return False
    return bool((crs.sub_crs_list[0] if crs.sub_crs_list else crs).is_projected)


def euclidean_offsets(text: str, places: FloatArray) -> FloatArray | None:
    """How far (N, 3) places (N, 3) on a map grid lie from where they are in Euclidean space, in the map's unit.

    Earth-centred coordinates, brought back onto the map's by the best rigid motion: what is left is the Earth's
    curvature and the projection's scale. Heights are taken as ellipsoidal. None where the system is no map grid, or is
    not known.
    """
    crs = _parsed(text)
    if crs is None:
        return None
    crs = crs.sub_crs_list[0] if crs.sub_crs_list else crs
    if not crs.is_projected:
        return None
    from pyproj import Transformer

    unit = crs.axis_info[0].unit_conversion_factor
    to_geographic = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
    longitude, latitude = to_geographic.transform(places[:, 0], places[:, 1])
    to_space = Transformer.from_crs(crs.geodetic_crs.to_3d(), {"proj": "geocent", "datum": "WGS84"}, always_xy=True)
    space = np.stack(to_space.transform(longitude, latitude, places[:, 2] * unit), axis=1) / unit
    if not np.isfinite(space).all():
        return None
    offsets: FloatArray = fit_similarity(space, places, with_scale=False).apply(space) - places
    return offsets


def _parsed(text: str) -> Any | None:
    try:
        pyproj = require("pyproj")
    except MissingExtra:
        return None
    try:
        return pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError:
        return None
