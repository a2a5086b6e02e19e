"""The matching plan for a desired spacing, and the reasons it reports."""

from dataclasses import replace

import numpy as np
import pytest
from wording import check_text

from reconstructors.mvs.plan import ImageSurvey, make_plan, measure_textured_share

SURVEY = ImageSurvey(side_px=1600, footprint=0.1, angle_deg=20.0, overlap=8, textured_share=0.9)


def test_default_matches_images_of_up_to_2000_pixels():
    plan = make_plan(SURVEY, None, None)
    assert (plan.scale, plan.spacing) == (1.0, 0.1)
    check_text(plan.reasons[0])
    large_plan = make_plan(replace(SURVEY, side_px=6000, footprint=0.02), None, None)
    assert (large_plan.scale, large_plan.spacing) == (0.25, 0.08)
    assert "1500 pixels" in check_text(large_plan.reasons[0])


def test_spacing_sets_the_image_size():
    plan = make_plan(SURVEY, 0.25, None)
    assert plan.scale == pytest.approx(0.4)
    assert plan.spacing == pytest.approx(0.25)
    for value in ("640 pixels", "0.40 of", "0.25"):
        assert value in plan.reasons[0]
    check_text(plan.reasons[0])
    # The scale is clamped between the smallest size that can be matched and the full size.
    fine_plan = make_plan(SURVEY, 0.01, None)
    assert (fine_plan.scale, fine_plan.spacing) == (1.0, 0.1)
    assert "0.01" in check_text(fine_plan.reasons[0])
    coarse_plan = make_plan(SURVEY, 10.0, None)
    assert coarse_plan.scale == pytest.approx(240 / 1600)
    assert "of 10 " in check_text(coarse_plan.reasons[0])
    assert coarse_plan.levels < plan.levels == 3


def test_sources_are_those_that_overlap_up_to_eight():
    counts = [make_plan(replace(SURVEY, overlap=overlap), None, None).sources for overlap in (0.5, 3, 7.5, 8, 12)]
    assert counts == [1, 3, 7, 8, 8]
    assert "20 degrees" in check_text(make_plan(replace(SURVEY, overlap=3), None, None).reasons[1])
    check_text(make_plan(SURVEY, None, None).reasons[1])
    assert make_plan(SURVEY, None, 5).sources == 5
    check_text(make_plan(SURVEY, None, 5).reasons[1])


def test_low_texture_adds_an_iteration():
    assert make_plan(SURVEY, None, None).photometric_iterations == 3
    low_texture_plan = make_plan(replace(SURVEY, textured_share=0.3), None, None)
    assert low_texture_plan.photometric_iterations == 4
    assert "30%" in check_text(low_texture_plan.reasons[2])


def test_texture_is_variation_within_a_patch():
    rng = np.random.default_rng(0)
    flat = np.full((90, 90), 128, np.uint8)
    assert measure_textured_share([flat]) == 0
    # Sensor noise is no texture, and neither are uniform patches of different brightness.
    assert measure_textured_share([(flat + rng.normal(0, 1.5, flat.shape)).round().astype(np.uint8)]) == 0
    assert measure_textured_share([np.kron(rng.integers(0, 256, (10, 10)), np.ones((9, 9))).astype(np.uint8)]) == 0
    noise = rng.integers(0, 256, (90, 90)).astype(np.uint8)
    assert measure_textured_share([noise]) == 1
    assert measure_textured_share([flat, noise]) == 0.5
    assert measure_textured_share([np.hstack([flat[:, :45], noise[:, :45]])]) == 0.5
