"""Transforms: known answers, group laws, recovery by fits, file round trips, and refusals."""

import numpy as np
import pytest
import shapes
from hypothesis import example, given, settings
from hypothesis import strategies as st
from shapes import UTM_DECIMAL as UTM
from wording import check_error

from pcbench.geometry.transform import Affine, Similarity, fit_similarity, format_matrix, read_matrix

no_deadline = settings(deadline=None, max_examples=40)  # must not fail on a busy machine
QUARTER_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])

coordinates = st.tuples(*[st.floats(-100, 100)] * 3).map(np.array)
axes = coordinates.filter(lambda axis: np.linalg.norm(axis) > 1e-3)
rotations = st.builds(shapes.rotation, axes, st.floats(-180, 180))
similarities = st.builds(Similarity, rotations, coordinates, st.floats(0.01, 100))
rigid_motions = st.builds(Similarity, rotations, coordinates)
PROBES = np.random.default_rng(0).uniform(-10, 10, (20, 3))


def assert_close(got, expected, size=1.0):
    # Coordinates up to `size`, a dozen roundings of 1e-16 each, and margin.
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13 * size)


# Known answers


def test_similarity_rotates_scales_then_translates():
    transform = Similarity(QUARTER_TURN, [10, 20, 30], 2)
    assert transform.apply(np.array([[1.0, 2, 3]])).tolist() == [[6, 22, 36]]
    assert transform.apply_normals(np.array([[1.0, 0, 0]])).tolist() == [[0, 1, 0]]
    assert transform.matrix.tolist() == [[0, -2, 0, 10], [2, 0, 0, 20], [0, 0, 2, 30], [0, 0, 0, 1]]
    assert transform.linear.tolist() == [[0, -2, 0], [2, 0, 0], [0, 0, 2]]


def test_identity_is_exact():
    assert (Similarity.identity().apply(PROBES) == PROBES).all()
    assert (Similarity.identity().matrix == np.eye(4)).all()


@no_deadline
@given(axes, st.floats(1e-9, 180), coordinates, st.floats(0.01, 100))
@example(np.array([1.0, 2.0, -3.0]), 180.0, np.ones(3), 1.0)  # a half turn: the trace does not determine the axis
@example(np.array([0.0, 0.0, 1.0]), 1e-9, np.ones(3), 1.0)  # an angle whose cosine rounds to 1
def test_motion_recovers_axis_angle_and_scale(axis, angle, position, scale):
    transform = Similarity(shapes.rotation(axis, angle), [4, 5, 6], scale).about(position)
    motion = transform.motion_at(position)
    assert_close(motion.shift, [4, 5, 6], size=1e4)
    assert motion.angle_deg == pytest.approx(angle, rel=1e-6, abs=1e-12)
    assert motion.scale == scale
    sign = np.sign(motion.axis @ axis) if angle > 180 - 1e-6 else 1  # a half turn has two opposite axes
    assert_close(motion.axis, sign * axis / np.linalg.norm(axis), size=1e7 if angle < 1e-3 else 1e3)


def test_no_rotation_has_no_axis():
    motion = Similarity(np.eye(3), [1, 0, 0]).motion_at([5e6, 0, 0])
    assert (motion.shift.tolist(), motion.angle_deg, motion.axis, motion.scale) == ([1, 0, 0], 0, None, 1)


def test_affine_maps_points_and_inverts():
    transform = Affine([[2, 0, 0], [0, 1, 0], [0, 0, -1]], [1, 0, 0])
    assert transform.apply(np.array([[1.0, 2, 3]])).tolist() == [[3, 2, -3]]
    assert transform.inverse().apply(np.array([[3.0, 2, -3]])).tolist() == [[1, 2, 3]]
    assert transform.matrix.tolist() == [[2, 0, 0, 1], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]


def test_affine_normals_stay_perpendicular_and_keep_their_length():
    generator = np.random.default_rng(1)
    transform = Affine(generator.normal(size=(3, 3)), np.ones(3))
    along, other = generator.normal(size=(2, 30, 3))
    normals = np.cross(along, other)
    moved = transform.apply_normals(normals)
    assert (
        np.abs((moved * (along @ transform.linear.T)).sum(axis=1)).max() < 1e-12 * np.abs(transform.linear).max() * 100
    )
    assert_close(np.linalg.norm(moved, axis=1), np.linalg.norm(normals, axis=1), 10)
    assert transform.apply_normals(np.zeros((1, 3))).tolist() == [[0, 0, 0]]  # zero vectors stay zero


def test_composition_applies_the_right_operand_first():
    rotation, shift = Similarity(QUARTER_TURN, np.zeros(3)), Similarity(np.eye(3), [1, 0, 0])
    point = np.array([[1.0, 0, 0]])
    assert (rotation @ shift).apply(point).tolist() == [[0, 2, 0]]
    assert (shift @ rotation).apply(point).tolist() == [[1, 1, 0]]
    stretch = Affine(np.diag([2.0, 1, 1]), np.zeros(3))
    assert (stretch @ rotation @ shift).apply(point).tolist() == [[0, 2, 0]]
    assert (stretch @ stretch).linear.tolist() == np.diag([4, 1, 1]).tolist()


# Properties


@no_deadline
@given(similarities)
def test_inverse(transform):
    for identity in (transform @ transform.inverse(), transform.inverse() @ transform):
        assert_close(identity.rotation, np.eye(3))
        assert identity.scale == pytest.approx(1, rel=1e-15)
    # The translation is multiplied and divided by the scale (up to 100).
    assert_close(transform.inverse().apply(transform.apply(PROBES)), PROBES, 1e4)


@no_deadline
@given(similarities, similarities)
def test_composition(first, second):
    assert_close((first @ second).apply(PROBES), first.apply(second.apply(PROBES)), 1e6)
    assert_close((first @ second).matrix, first.matrix @ second.matrix, 1e6)


def test_long_products_remain_rotations():
    step = Similarity(shapes.rotation([1, 2, 3], 1.0), [0.1, 0, 0])
    product = step
    for _ in range(3599):
        product = step @ product
    assert_close(product.rotation @ product.rotation.T, np.eye(3))
    assert_close(product.rotation, np.eye(3), 1e3)  # 3600 rotations of one degree, each with an error of 1e-16


@no_deadline
@given(similarities)
def test_about_moves_the_origin_of_a_transform(transform):
    # Fitted to clouds after subtracting the origin, applied to the original clouds.
    positions = transform.about(UTM).apply(PROBES + UTM)
    assert_close(positions, transform.apply(PROBES) + UTM, np.abs(UTM).max() * (1 + transform.scale))


@no_deadline
@given(similarities)
def test_matrix_round_trip(transform):
    restored = Similarity.from_matrix(transform.matrix)
    assert restored.scale == pytest.approx(transform.scale, rel=1e-14)
    assert_close(restored.rotation, transform.rotation)
    assert (restored.translation == transform.translation).all()
    affine = Affine(transform.linear, transform.translation)
    assert_close(affine.apply(PROBES), transform.apply(PROBES), 1e4)
    assert_close(affine.apply_normals(PROBES), transform.apply_normals(PROBES), 1e2)


# Recovery


@no_deadline
@given(similarities, st.integers(3, 30), st.integers(0, 2**32 - 1))
def test_fit_similarity_recovers_exact_transforms(transform, count, seed):
    candidate = np.random.default_rng(seed).normal(size=(count, 3))
    fitted = fit_similarity(candidate, transform.apply(candidate))
    # Three random points may be nearly collinear, so the fit is tested and not its parameters.
    np.testing.assert_allclose(fitted.apply(candidate), transform.apply(candidate), atol=1e-9 * transform.scale + 1e-11)


@pytest.mark.parametrize("count", [3, 4, 50])
def test_fit_similarity_of_planar_sets(count):
    """Fit 200 exact planar motions, which need the reflection correction and the translation after it."""
    generator = np.random.default_rng(count)
    reflections = 0
    for _ in range(200):
        flat = np.column_stack([generator.normal(size=(count, 2)), np.zeros(count)])
        tilt = shapes.rotation(generator.normal(size=3), generator.uniform(0, 180))
        candidate = flat @ tilt.T + generator.normal(size=3) * 10
        truth = Similarity(
            shapes.rotation(generator.normal(size=3), generator.uniform(0, 180)), generator.normal(size=3) * 10
        )
        reference = truth.apply(candidate)
        c, r = candidate - candidate.mean(axis=0), reference - reference.mean(axis=0)
        u, _, vt = np.linalg.svd(r.T @ c)
        reflections += np.linalg.det(u @ vt) < 0
        for with_scale in (False, True):
            fitted = fit_similarity(candidate, reference, with_scale=with_scale)
            assert np.linalg.det(fitted.rotation) == pytest.approx(1, abs=1e-12)
            assert fitted.scale == pytest.approx(1, abs=1e-12)
            np.testing.assert_allclose(fitted.apply(candidate), reference, atol=1e-11)
            # The tilt of a thin triangle's plane is less well determined.
            np.testing.assert_allclose(fitted.rotation, truth.rotation, atol=1e-9)
            np.testing.assert_allclose(fitted.translation, truth.translation, atol=1e-7)
    assert reflections > 20  # the reflection correction was needed


def test_fit_of_a_mirror_image_is_a_rotation():
    corners = np.stack(np.meshgrid([-3, 3], [-2, 2], [-1, 1]), axis=-1).reshape(-1, 3).astype(float)
    fitted = fit_similarity(corners, corners * [1, 1, -1])
    # The flattest axis stays mirrored: a rotation that fits it would have larger errors along the others.
    assert_close(fitted.rotation, np.eye(3))
    # Umeyama's scale: (9 + 4 - 1) / (9 + 4 + 1).
    assert fitted.scale == pytest.approx(12 / 14)


def test_fit_with_and_without_scale():
    candidate, _, _ = shapes.city(500, seed=1)
    truth = Similarity(shapes.rotation([1, 1, 0], 20), [1, 2, 3], 1.03)
    assert fit_similarity(candidate, truth.apply(candidate)).scale == pytest.approx(1.03, rel=1e-13)
    rigid = fit_similarity(candidate, truth.apply(candidate), with_scale=False)
    assert rigid.scale == 1
    assert_close(rigid.rotation, truth.rotation, 10)


def test_fit_far_from_the_origin():
    candidate, _, _ = shapes.city(500, seed=2)
    truth = Similarity(shapes.rotation([0, 0, 1], 30), [1, 2, 3]).about(UTM)
    fitted = fit_similarity(candidate + UTM, truth.apply(candidate + UTM))
    # Coordinates round to 1e-9.
    np.testing.assert_allclose(fitted.apply(candidate + UTM), truth.apply(candidate + UTM), atol=1e-8)


def test_fit_is_the_least_squares_optimum():
    generator = np.random.default_rng(4)
    candidate = generator.normal(size=(100, 3))
    reference = candidate @ shapes.rotation([1, 2, 3], 40).T * 1.5 + generator.normal(size=(100, 3)) * 0.1

    def cost(transform):
        return ((transform.apply(candidate) - reference) ** 2).sum()

    best = fit_similarity(candidate, reference)
    for _ in range(100):
        rotation = shapes.rotation(generator.normal(size=3), 0.1)
        perturbed = Similarity(
            rotation @ best.rotation, best.translation + generator.normal(size=3) * 1e-3, best.scale * 1.001
        )
        assert cost(perturbed) > cost(best)


def test_weights_equal_repetitions():
    generator = np.random.default_rng(5)
    candidate, reference = generator.normal(size=(2, 10, 3))
    repeats = generator.integers(0, 4, 10)
    weighted = fit_similarity(candidate, reference, weights=repeats.astype(float))
    repeated = fit_similarity(np.repeat(candidate, repeats, axis=0), np.repeat(reference, repeats, axis=0))
    assert_close(weighted.matrix, repeated.matrix, 100)


def test_affine_inverse_of_strong_stretching():
    transform = Affine(np.diag([1.0, 1.0, 1e-9]), np.zeros(3))
    assert_close(transform.inverse().linear, np.diag([1, 1, 1e9]), 1e9)
    assert_close(transform.inverse().inverse().linear, transform.linear)


# Files


@no_deadline
@given(rigid_motions)
def test_rigid_files_round_trip_exactly(tmp_path_factory, transform):
    path = tmp_path_factory.getbasetemp() / "rigid.txt"
    path.write_text(format_matrix(transform))
    restored = read_matrix(path)
    assert (restored.matrix == transform.matrix).all()
    assert restored.scale == 1
    assert format_matrix(restored) == format_matrix(transform)


@no_deadline
@given(similarities)
@example(Similarity(shapes.rotation([0, 1, 1], 2.225073858507203e-309), np.zeros(3), 6.5))
def test_scaled_files_round_trip_to_rounding(tmp_path_factory, transform):
    path = tmp_path_factory.getbasetemp() / "scaled.txt"
    path.write_text(format_matrix(transform))
    # Subnormal numbers have a spacing of 5e-324: half of it, times a scale of 100, is the rounding.
    np.testing.assert_allclose(read_matrix(path).matrix, transform.matrix, rtol=4e-16, atol=2.5e-322)


@pytest.mark.parametrize(
    "text",
    [
        "0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1\n",
        "0 -1 0 1\n1 0 0 2\n0 0 1 3",
        "# found by hand\n\n0,-1, 0,1 # x\n1,0,0,2\r\n0\t0\t1e0\t3\n\n",
    ],
)
def test_matrix_formats_are_read(tmp_path, text):
    (tmp_path / "m.txt").write_text(text)
    transform = read_matrix(str(tmp_path / "m.txt"))
    assert (transform.rotation == QUARTER_TURN).all()
    assert transform.translation.tolist() == [1, 2, 3]
    assert transform.scale == 1


def test_printed_digits_restore_the_matrix(tmp_path):
    rotation = shapes.rotation([1, 2, 3], 77)
    (tmp_path / "m.txt").write_text("\n".join(" ".join(f"{v:.7f}" for v in [*row, 5.0]) for row in rotation))
    np.testing.assert_allclose(read_matrix(tmp_path / "m.txt").rotation, rotation, atol=2e-7)


# Refusals


def matrix_with(**changes):
    result = np.eye(4)
    for key, value in changes.items():
        result[int(key[1]), int(key[2])] = value
    return result


COLLINEAR_POINTS = np.outer(np.arange(5.0), [1, 2, 3])
RANDOM_POINTS = np.random.default_rng(7).normal(size=(5, 3))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Similarity(np.eye(4), np.zeros(3)),
        lambda: Similarity(np.eye(3), np.zeros(2)),
        lambda: Similarity(np.eye(3), [0, 0, np.nan]),
        lambda: Similarity(np.eye(3), np.zeros(3), 0),
        lambda: Similarity(np.eye(3), np.zeros(3), -1),
        lambda: Similarity(np.eye(3), np.zeros(3), np.inf),
        lambda: Similarity(np.eye(3), np.zeros(3), 1e101),
        lambda: Similarity(np.eye(3), [1e308] * 3),
        lambda: Similarity.from_matrix(1e308 * np.eye(4)),
        lambda: Similarity(2 * np.eye(3), np.zeros(3)),
        lambda: Similarity(np.diag([1, 1, -1]), np.zeros(3)),
        lambda: Similarity([[1, 0, 0], [0.6, 0.8, 0], [0, 0, 1]], np.zeros(3)),
        lambda: Similarity.from_matrix(np.eye(3)),
        lambda: Similarity.from_matrix(matrix_with(m30=0.5)),
        lambda: Similarity.from_matrix(matrix_with(m00=-1)),
        lambda: Similarity.from_matrix(matrix_with(m00=0)),
        lambda: Similarity.from_matrix(matrix_with(m01=0.1)),
        lambda: Similarity.from_matrix(matrix_with(m00=np.nan)),
        lambda: Affine(np.eye(4), np.zeros(3)),
        lambda: Affine(np.eye(3), [np.inf, 0, 0]),
        lambda: Affine(np.diag([1, 1, 0]), np.zeros(3)),
        lambda: Affine(np.zeros((3, 3)), np.zeros(3)),
        lambda: fit_similarity(RANDOM_POINTS, RANDOM_POINTS[:4]),
        lambda: fit_similarity(RANDOM_POINTS[:, :2], RANDOM_POINTS[:, :2]),
        lambda: fit_similarity(RANDOM_POINTS[:2], RANDOM_POINTS[:2]),
        lambda: fit_similarity(COLLINEAR_POINTS, RANDOM_POINTS),
        lambda: fit_similarity(RANDOM_POINTS, COLLINEAR_POINTS),
        lambda: fit_similarity(COLLINEAR_POINTS + UTM, COLLINEAR_POINTS),
        lambda: fit_similarity(np.ones((4, 3)), RANDOM_POINTS[:4]),
        lambda: fit_similarity(RANDOM_POINTS, np.ones((5, 3))),
    ],
)
def test_invalid_arguments_are_refused(make):
    with check_error():
        make()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_encodings_of_matrix_files(tmp_path, encoding):
    (tmp_path / "m.txt").write_bytes(format_matrix(Similarity(np.eye(3), np.array([1.5, 2, 3]))).encode(encoding))
    assert read_matrix(tmp_path / "m.txt").translation.tolist() == [1.5, 2, 3]


@pytest.mark.parametrize(
    "content",
    [
        None,
        b"\xff\xfe\x00",
        b"",
        b"1 0 0\n0 1 0\n0 0 1\n",
        b"1 0 0 0\n0 1 0 0\n0 0 1\n",
        b"1 0 0 0\n0 1 0 x\n0 0 1 0\n",
        b"1 0 0 0\n0 1 0 0\n0 0 -1 0\n",
        b"1 0 0 nan\n0 1 0 0\n0 0 1 0\n",
        b"1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 2",
    ],
)
def test_invalid_files_are_refused(tmp_path, content):
    path = tmp_path / "m.txt"
    if content is not None:
        path.write_bytes(content)
    with check_error():
        read_matrix(path)
