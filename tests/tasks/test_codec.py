"""The stored form of values: equal in all bits when they are read, and without code."""

import functools
import json
import math
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from pcbench.measure.tiled import (
    directions,
    even,
    maps,
    nearby,
    normals,
    presets,
    ranks,
    runs,
    stored,
    tiles,
    windows,
)
from pcbench.tasks.codec import Encoded, as_json, decode, encode, fingerprint, result_type, types_in


class Inner(NamedTuple):
    values: np.ndarray
    text: str | None = None


@dataclass(frozen=True)
class Outer:
    inner: tuple[Inner, ...]
    by_name: dict[str, "Inner"]
    count: int = 0


def returned(value, kind=None):
    tree, arrays = encode(value)
    return decode(Encoded(json.loads(as_json(tree)), arrays), types_in(kind))


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        -(2**200),
        0.1 + 0.2,
        -0.0,
        5e-324,
        math.inf,
        "\u20ac \udc80 \0 \n",
        b"\0\xff",
        b"",
        [],
        [1, (2, [3.0], ())],
        {"a": (1,), 2: None, (3, "b"): {}},
        Path("a/b\udcff"),
    ],
)
def test_plain_values(value):
    found = returned(value)
    assert found == value and repr(found) == repr(value)


def test_nan():
    assert math.isnan(returned(math.nan))


@pytest.mark.parametrize(
    "array",
    [
        np.array([np.nan, -np.inf, -0.0, 5e-324]),
        np.zeros((0, 3)),
        np.zeros((2, 0), np.uint8),
        np.array(7, np.uint64),
        np.asfortranarray(np.arange(6, dtype=np.int32).reshape(2, 3)),
        np.arange(20)[::-3],
        np.array([True, False]),
        np.array(["a", "bcd"]),
        np.array([(1, 2.5)], dtype=[("a", "<u2"), ("b", ">f4")]),
        np.broadcast_to(np.float32(1), (3, 2)),
    ],
)
def test_arrays(tmp_path, array):
    found = returned({"x": array})["x"]
    assert (found.dtype, found.shape) == (array.dtype, array.shape) and found.tobytes() == array.tobytes()


@pytest.mark.parametrize("scalar", [np.float64(0.1), np.int32(-3), np.bool_(True), np.str_("a"), np.uint64(2**64 - 1)])
def test_numpy_scalars_keep_their_type(scalar):
    found = returned(scalar)
    assert type(found) is type(scalar) and found == scalar


def test_types_are_those_that_the_reader_names():
    value = Outer((Inner(np.arange(2.0)), Inner(np.zeros(0), "b")), {"a": Inner(np.ones(1))}, 3)
    found = returned(value, Outer)
    assert isinstance(found, Outer) and (found.count, found.inner[1].text) == (3, "b")
    np.testing.assert_array_equal(found.by_name["a"].values, [1.0])
    for kind in (None, Inner):
        with pytest.raises(ValueError, match="Outer"):
            returned(value, kind)


@pytest.mark.parametrize("value", [{1, 2}, lambda: 0, np.array([None]), object(), 1j, functools.partial(print)])
def test_other_values_cannot_be_stored(value):
    with pytest.raises(TypeError):
        encode([value])


def test_a_mapping_of_another_type_becomes_a_dict():
    assert returned(OrderedDict(a=1)) == {"a": 1}


def test_fingerprints():
    values = [np.arange(3.0), np.arange(3), np.arange(4.0), [0.0, 1.0, 2.0], (0.0, 1.0, 2.0), "a", b"a", None, 0, False]
    assert len({fingerprint(value) for value in values}) == len(values)
    assert fingerprint(Inner(np.ones(2))) == fingerprint(Inner(np.ones(2)))


@pytest.mark.parametrize(
    ("function", "names"),
    [
        (stored.piece_bounds, set()),
        (runs.store_piece, {"RunSummary", "PieceNotes", "LasCounts", "CoordinateCounts", "ValueCount"}),
        (even.count_inside, {"CountedPoints"}),
        (even.picked_points, {"PickedPoints"}),
        (nearby.spread_tile, {"PickedPoints"}),
        (nearby.near_points, {"Matches", "NearPoints"}),
        (nearby.thin_tile, {"TileSummary"}),
        (nearby.displace_tile, {"TileSummary"}),
        (windows.points_in_windows, {"StoredPoints"}),
        (tiles.make_tile, {"TileSummary"}),
        (presets.crop_tile, {"TileSummary"}),
        (normals.add_normals, {"BitHistogram"}),
        (normals.add_wide_normals, set()),
        (functools.partial(ranks.count_values, wanted=None), {"BitHistogram"}),
        (maps.sample_map, {"MapPoints"}),
        (maps.write_tile_of_map, set()),
    ],
)
def test_annotations_name_all_types_of_results(function, names):
    assert {name.rpartition(".")[2] for name in types_in(result_type(function))} == names


def test_shared_values_are_of_known_types():
    names = {name.rpartition(".")[2] for name in types_in(directions.TiledPair)}
    own = {"TiledPair", "TiledCloud", "CorrelationGrid", "PixelGrid", "FitFrame", "PointLabels", "Displacement"}
    assert names == own
