"""A scale error is no deformation if the registration solved for the scale; an error of a given scale is one."""

import numpy as np
import pytest

from pcbench import Cloud, Similarity, deform
from pcbench.geometry.transform import format_matrix
from pcbench.scenes.synthetic import city

SCALE = 1.03  # candidate -> reference
SCALE_ERROR = 1.002  # scale error of the result of both methods: 20 cm at 100 m, ten times the noise


@pytest.fixture(scope="module")
def clouds():
    """Return a city in metres with 2 cm noise, and another sample of it, too small by SCALE, also in "metres"."""
    town, rng = city(3), np.random.default_rng(5)
    reference, candidate = (town.sample(count, rng)[0] + rng.normal(0, 0.02, (count, 3)) for count in (40_000, 20_000))
    return Cloud(reference, unit="m"), Cloud(candidate / SCALE, unit="m")


def test_a_scale_solved_by_control_points_is_no_deformation(clouds, tmp_path):
    control_points = clouds[0].points[::4000]
    rows = np.hstack([control_points / SCALE, SCALE_ERROR * control_points]).tolist()
    lines = [" ".join([f"p{index}", *map(repr, row)]) for index, row in enumerate(rows)]
    (tmp_path / "pairs.txt").write_text("\n".join(lines))
    registration, deformation = deform(*clouds, f"points:{tmp_path / 'pairs.txt'}")
    assert registration.solved_scale
    assert (deformation.verdict, deformation.model) == ("none", "similarity")


@pytest.mark.long
def test_a_wrong_given_scale_is_a_deformation(clouds, tmp_path):
    (tmp_path / "T.txt").write_text(format_matrix(Similarity(np.eye(3), np.zeros(3), SCALE * SCALE_ERROR)))
    registration, deformation = deform(*clouds, f"matrix:{tmp_path / 'T.txt'}")
    assert not registration.solved_scale
    assert (deformation.verdict, deformation.model) == ("similarity", "similarity")
