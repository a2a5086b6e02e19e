"""How much is done for what is wanted, and the reasons that are given."""

from dataclasses import replace

import numpy as np
import pytest
from wording import said

from reconstructors.mvs.plan import ImageSurvey, make_plan, textured_share

USUAL = ImageSurvey(side=1600, footprint=0.1, angle_deg=20.0, overlap=8, textured=0.9)


def test_by_default_images_of_up_to_2000_pixels_give_what_they_can():
    plan = make_plan(USUAL, None, None)
    assert (plan.scale, plan.spacing) == (1.0, 0.1)
    said(plan.reasons[0])
    large = make_plan(replace(USUAL, side=6000, footprint=0.02), None, None)
    assert (large.scale, large.spacing) == (0.25, 0.08)
    assert "1500 pixels" in said(large.reasons[0])


def test_a_spacing_decides_the_size():
    plan = make_plan(USUAL, 0.25, None)
    assert plan.scale == pytest.approx(0.4)
    assert plan.spacing == pytest.approx(0.25)
    for value in ("640 pixels", "0.40 of", "0.25"):
        assert value in plan.reasons[0]
    said(plan.reasons[0])
    # Nothing is finer than the photographs, and nothing coarser than can be matched.
    finer = make_plan(USUAL, 0.01, None)
    assert (finer.scale, finer.spacing) == (1.0, 0.1)
    assert "0.01" in said(finer.reasons[0])
    coarser = make_plan(USUAL, 10.0, None)
    assert coarser.scale == pytest.approx(240 / 1600)
    assert "of 10 " in said(coarser.reasons[0])
    assert coarser.levels < plan.levels == 3


def test_as_many_sources_as_overlap_up_to_eight():
    counts = [make_plan(replace(USUAL, overlap=overlap), None, None).sources for overlap in (0.5, 3, 7.5, 8, 12)]
    assert counts == [1, 3, 7, 8, 8]
    assert "20 degrees" in said(make_plan(replace(USUAL, overlap=3), None, None).reasons[1])
    said(make_plan(USUAL, None, None).reasons[1])
    assert make_plan(USUAL, None, 5).sources == 5
    said(make_plan(USUAL, None, 5).reasons[1])


def test_little_texture_asks_for_more_iterations():
    assert make_plan(USUAL, None, None).iterations == 3
    poor = make_plan(replace(USUAL, textured=0.3), None, None)
    assert poor.iterations == 4
    assert "30%" in said(poor.reasons[2])


def test_texture_is_what_varies_within_a_patch():
    rng = np.random.default_rng(0)
    flat = np.full((90, 90), 128, np.uint8)
    assert textured_share([flat]) == 0
    # The noise of a sensor is none, nor are brighter patches beside darker ones.
    assert textured_share([(flat + rng.normal(0, 1.5, flat.shape)).round().astype(np.uint8)]) == 0
    assert textured_share([np.kron(rng.integers(0, 256, (10, 10)), np.ones((9, 9))).astype(np.uint8)]) == 0
    noise = rng.integers(0, 256, (90, 90)).astype(np.uint8)
    assert textured_share([noise]) == 1
    assert textured_share([flat, noise]) == 0.5
    assert textured_share([np.hstack([flat[:, :45], noise[:, :45]])]) == 0.5
