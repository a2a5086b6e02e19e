"""Changes are told apart from a deformation of the whole scene."""

import numpy as np
import pytest
from changed_scenes import disc, ground

from pcbench.deformation import Side, separate_changes
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface


def side(points):
    return Side(Surface(Index(points)), np.ones(len(points), bool), Cloud(points))


@pytest.mark.parametrize("bend", [0.0, 0.1, 1.0])
def test_a_raised_part_of_a_bent_scene_is_the_only_change(bend):
    candidate = ground(2)
    field = bend * ((candidate[:, :2] / 50) ** 2).sum(axis=1)[:, None] * [0, 0, 1]
    part = np.where(disc(candidate, 6.0), 0.6, 0.0)[:, None] * [0, 0, 1]
    found = separate_changes(side(ground(1)), side(candidate + field + part)).sampled.found
    assert [change.kind for change in found] == ["moved"]
    assert found[0].mean == pytest.approx(0.6, rel=0.15)
    assert found[0].area == pytest.approx(np.pi * 36, rel=0.35)
