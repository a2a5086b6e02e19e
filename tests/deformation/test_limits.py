"""A verdict needs a size that is surely not negligible, and a denial needs a limit."""

from dataclasses import replace

import numpy as np
import pytest
from bends import SIZE, Cell, Scene, bends

from pcbench.deformation import Deformation, DetectableSize
from pcbench.deformation.model import Noise
from pcbench.deformation.size import stated_rms
from pcbench.deformation.verdict import negligible_rms


@pytest.mark.parametrize(("times", "verdict"), [(0.47, "none"), (0.8, "non-affine")])
def test_the_whole_interval_of_a_stated_size_exceeds_the_negligible_one(times, verdict):
    """A bend of 47 % of the noise is significant, but the interval of its size reaches below 40 %."""
    cell = Cell("gauss", 0)
    scene = Scene(6_000)
    bend = times * cell.total * scene.beyond_affine(bends(scene.places, SIZE)["dome"])
    judged = scene.judge(scene.noise(cell, None, 3) + bend)
    assert judged.finding.evidence.significant
    assert judged.finding.verdict == verdict


@pytest.mark.parametrize("negligible", [0.4, 1.5])
def test_the_interval_of_the_stated_size_starts_at_the_negligible_one(negligible):
    noise = Noise(0.64, np.array([0.36]), np.array([1.0]))
    size = stated_rms(negligible, noise)
    assert size - 1.96 * np.hypot(0.08, 0.04 * size) == pytest.approx(negligible)
    assert negligible_rms(noise) == pytest.approx(0.4)


def test_no_deformation_without_a_size_limit_is_undecided():
    """None of any size was found, but one of any size may be there."""
    blind = Deformation("none", "rigid", negligible_rms=0.01, detectable=(DetectableSize("dome"),))
    assert blind.without_empty_denial().verdict == "undecided"
    assert blind.limit_problem in blind.without_empty_denial().sentence()
    doubtful = replace(blind, verdict="undecided", conditional_verdict="none")
    assert doubtful.without_empty_denial().conditional_verdict is None
    seen = replace(blind, minimum_detectable_rms=0.02)
    for result in (seen, replace(blind, verdict="non-affine")):
        assert result.without_empty_denial() is result
