"""Regions as text on the command line, and clouds cropped to them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wording import check_error

import pcbench
from pcbench import Box, Cloud, Polygon, Sphere, crop, parse_region
from pcbench.errors import InputError
from pcbench.geometry.region_text import as_region

no_deadline = settings(deadline=None, max_examples=40)  # must not fail on a busy machine
CLOUD = Cloud(np.random.default_rng(0).normal(size=(500, 3)))


def test_boxes_and_spheres():
    assert parse_region("box:0,0,0,1,2,3", CLOUD).text == "box:0,0,0,1,2,3"
    assert parse_region(" Sphere: 1, 2, 3, 2.5 ", CLOUD).text == "sphere:1,2,3,2.5"


def test_regions_relative_to_the_reference():
    assert parse_region("none", CLOUD) is None
    assert parse_region("REFERENCE", CLOUD).text == Box.around(CLOUD).text
    assert parse_region("quantile:0.9", CLOUD).text == Sphere.around(CLOUD, 0.9).text


def test_as_region_accepts_objects_and_texts():
    box = Box([0, 0, 0], [1, 1, 1])
    assert as_region(box, CLOUD) is box
    assert as_region("box:0,0,0,1,1,1", CLOUD).text == box.text
    for value in (None, 3, [0, 0, 0, 1, 1, 1]):
        with check_error():
            as_region(value, CLOUD)


# Clouds cropped to a region


@pytest.mark.parametrize("region", ["sphere:0,0,0,1", Sphere([0, 0, 0], 1)], ids=["text", "object"])
def test_a_crop_applies_to_all_fields(region):
    cloud = Cloud(CLOUD.points, normals=-CLOUD.points, attributes={"row": np.arange(500)}, unit="m")
    inside = np.flatnonzero((CLOUD.points**2).sum(axis=1) <= 1)
    result = crop(cloud, region)
    assert 30 < len(result) < 300
    np.testing.assert_array_equal(result.attributes["row"], inside)
    np.testing.assert_array_equal(result.normals, -CLOUD.points[inside])
    assert result.unit == "m"
    np.testing.assert_array_equal(crop(CLOUD.points, region).points, result.points)


def test_a_crop_that_contains_all_points_returns_the_cloud():
    assert crop(CLOUD, "none") is CLOUD
    np.testing.assert_array_equal(crop(CLOUD, "reference").points, CLOUD.points)
    assert len(crop(CLOUD, "quantile:0.5")) == 250


@pytest.mark.parametrize(
    "region",
    [
        "box:9,9,9,10,10,10",
        Box([9, 9, 9], [10, 10, 10]),
        Polygon([[9, 9], [10, 9], [10, 10]]),
        "cube:1",
        7,
    ],
)
def test_empty_and_invalid_crops_are_refused(region):
    with check_error():
        pcbench.crop(CLOUD, region)


# Refusals


@pytest.mark.parametrize(
    "text",
    [
        "",
        "cube:1",
        "none:1",
        "reference:",
        "polygon:",
        "polygon",
        "box:1,2,3",
        "box",
        "boxes:0,0,0,1,1,1",
        "truth/zone.geojson",
        "box:1,2,3,4,5,x",
        "box:1,2,3,4,5,nan",
        "box:1,2,3,4,5,inf",
        "box:1,2,3,4,5,1e200",
        "box:1,2,3,4,1,6",
        "sphere:1,2,3",
        "sphere:1,2,3,",
        "sphere:1,2,3,0",
        "sphere:1,2,3,-1",
        "quantile:",
        "quantile:0",
        "quantile:1.01",
        "quantile:99%",
        "polygon:/nowhere/a.json",
        "polygon:/",
        "polygon:a\0b",
    ],
)
def test_invalid_texts_are_refused(text):
    with check_error():
        parse_region(text, CLOUD)


def test_a_quantile_of_coincident_points_is_refused():
    with check_error():
        parse_region("quantile:0.5", Cloud(np.vstack([np.zeros((9, 3)), np.ones((1, 3))])))


@no_deadline
@given(st.text(max_size=30) | st.from_regex(r"(box|sphere|quantile|polygon):[-0-9.,e ]{0,30}", fullmatch=True))
def test_any_text_gives_a_region_or_a_one_line_error(text):
    try:
        region = parse_region(text, CLOUD)
    except InputError as error:
        assert len(str(error).splitlines()) == 1 or "polygon" in text
    else:
        assert region is None or region.contains(CLOUD.points).shape == (500,)
