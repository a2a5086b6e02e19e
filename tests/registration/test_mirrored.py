"""Mirrored candidates: the cause is named with the command that undoes it, and nothing else is called mirrored."""

import numpy as np
import pytest
from click.testing import CliRunner
from optional import import_or_skip
from wording import check_error, check_text

from pcbench import Cloud, read_cloud, register, write_cloud
from pcbench.cli.convert import convert
from pcbench.errors import RegistrationError
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.reflections import REFLECTIONS, reflection
from pcbench.geometry.transform import Similarity
from pcbench.registration import Target
from pcbench.registration.mirrored import find_reflection
from pcbench.registration.result import MIRRORED

# Boxes on the ground: centre and size. No reflection maps them onto themselves.
BOXES = [((3, 2, 1), (2, 4, 2)), ((-4, 3, 1.5), (3, 1, 3)), ((-2, -5, 0.5), (1, 5, 1)), ((5, -4, 2), (1, 1, 4))]


def town(seed, count=4000, noise=0.0, boxes=BOXES):
    rng = np.random.default_rng(seed)
    parts = [np.column_stack([rng.uniform(-10, 10, (count // 2, 2)), np.zeros(count // 2)])]
    for center, size in boxes:
        offsets = rng.uniform(-0.5, 0.5, (count // 8, 3))
        face = rng.integers(0, 6, len(offsets))
        offsets[np.arange(len(offsets)), face // 2] = np.where(face % 2, 0.5, -0.5)
        parts.append(offsets * size + center)
    points = np.concatenate(parts)
    return points + rng.normal(size=points.shape) * noise


def codes(registration):
    return [notice.code for notice in registration.warnings]


@pytest.mark.parametrize("axes", ["x", "z", "yz"])
def test_a_mirrored_candidate_is_named(axes):
    candidate = Cloud(town(2, noise=0.02)).transformed(reflection(axes))
    registration = register(town(1), candidate)
    assert registration.doubtful
    assert registration.warnings[0].code == MIRRORED
    check_text(str(registration.warnings[0]))


def test_a_cloud_mirrored_about_its_centre_far_from_the_origin():
    far = np.array([5e5, 5.6e6, 100.0])
    candidate = town(2) * [-1, 1, 1] + far + [2, 0, 0]
    assert codes(register(town(1) + far, candidate))[0] == MIRRORED
    assert MIRRORED in codes(register(town(1) + far, candidate, "none"))


def test_a_mirrored_candidate_in_any_pose():
    import_or_skip("kiss_matcher")
    turn = Similarity(np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]), np.array([40.0, 30, 5]))
    with check_error(RegistrationError):
        register(town(3, 2000), turn.apply(town(4, 2000) * [1, -1, 1]), "global")


def test_other_candidates_are_not_called_mirrored():
    turn = Similarity(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
    for candidate in (town(2), turn.apply(town(2)), town(2, boxes=BOXES[:2]), town(2, boxes=[((0, 0, 1), (9, 2, 2))])):
        assert MIRRORED not in codes(register(town(1), candidate))


def test_a_symmetric_scene_is_not_called_mirrored():
    ground = np.random.default_rng(1).uniform(-10, 10, (4000, 2))
    points = np.column_stack([ground, np.sin(ground[:, 0]) + 0.5 * np.cos(ground[:, 1])])
    target = Target(Surface(Index(points[::2])))
    assert find_reflection(target, points[1::2], np.zeros(3), with_scale=False) is None


def test_convert_undoes_a_reflection(tmp_path):
    points = town(1, 80)
    cloud = Cloud(points, normals=np.tile([0.6, 0, 0.8], (len(points), 1)))
    for axes in REFLECTIONS:
        write_cloud(tmp_path / "mirrored.ply", cloud.transformed(reflection(axes)))
        arguments = [str(tmp_path / "mirrored.ply"), str(tmp_path / "out.ply"), "--mirror", axes]
        assert CliRunner().invoke(convert, arguments).exit_code == 0
        back = read_cloud(tmp_path / "out.ply")
        np.testing.assert_array_equal(back.points, cloud.points)
        np.testing.assert_allclose(back.normals, cloud.normals, atol=1e-7)  # written in float32


def test_a_matrix_that_mirrors_is_refused_with_the_cause():
    with check_error():
        register(town(1, 80), town(1, 80), np.diag([1.0, -1, 1, 1]))
