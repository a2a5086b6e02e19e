"""Known deformations: their size, their record, and reproducing them from it."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from wording import check_error, check_text

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.geometry.transform import Affine, Similarity
from pcbench.scenes.synthetic.warp import KINDS, Warp, make_warp, similarity_from_angles

RMS = 0.25


def hills_cloud(count=4000, seed=0, offset=(0, 0, 0)):
    """Return points of z = 8 sin(x / 15) cos(y / 11) over 120 x 70, with normals."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, count)) * [[60], [35]]
    z = 8 * np.sin(x / 15) * np.cos(y / 11)
    slopes = 8 / 15 * np.cos(x / 15) * np.cos(y / 11), -8 / 11 * np.sin(x / 15) * np.sin(y / 11)
    normals = np.stack([-slopes[0], -slopes[1], np.ones(count)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(np.stack([x, y, z], axis=1) + offset, normals=normals, unit="m")


def affine_residual(source, target):
    """Return the residual (N, 3) of the best affine map before -> after, by the normal equations."""
    design = np.column_stack([source - source.mean(axis=0), np.ones(len(source))])
    return target - design @ np.linalg.solve(design.T @ design, design.T @ target)


def warp_from_record(record):
    after = Similarity.from_matrix(record["after"])
    arrays = (np.array(record[key]) for key in ("centre", "axes", "lengths"))
    return Warp(record["kind"], record["amplitude"], *arrays, after)


@pytest.mark.parametrize("kind", KINDS)
def test_amplitude_is_the_rms_beyond_affine_maps(kind):
    cloud = hills_cloud()
    warp = make_warp(kind, cloud.points, RMS)
    warped_points = warp.apply(cloud.points)
    residual = affine_residual(cloud.points, warped_points)
    assert np.sqrt(np.square(residual).sum(axis=1).mean()) == pytest.approx(RMS, rel=1e-9)
    record = json.loads(json.dumps(warp.record(cloud.points)))
    assert record["rms_beyond_affine"] == pytest.approx(RMS, rel=1e-9)
    assert record["max_beyond_affine"] == pytest.approx(np.linalg.norm(residual, axis=1).max())
    np.testing.assert_array_equal(warp_from_record(record).apply(cloud.points), warped_points)
    # The affine part is the displacement without the residual.
    matrix = np.array(record["affine_part"])
    np.testing.assert_allclose(
        Affine(matrix[:3, :3], matrix[:3, 3]).apply(cloud.points), warped_points - residual, atol=1e-9
    )


def test_displacements_of_each_kind():
    points = hills_cloud().points
    displacements = {kind: make_warp(kind, points, RMS).displacement(points) for kind in KINDS}
    r = np.hypot(points[:, 0] - displacements["dome"][:, 0], points[:, 1])
    for kind in ("dome", "bowl", "subsidence"):
        np.testing.assert_allclose(displacements[kind][:, :2], 0, atol=1e-15)
    is_inner, is_outer = r < 15, r > 50
    assert displacements["dome"][is_inner, 2].mean() > displacements["dome"][is_outer, 2].mean()
    np.testing.assert_allclose(displacements["bowl"], -displacements["dome"])
    is_high, is_low = points[:, 2] > 5, np.abs(points[:, 2]) < 0.5
    for kind in ("shear", "twist"):
        np.testing.assert_allclose(displacements[kind][:, 2], 0, atol=1e-15)
        assert (
            np.linalg.norm(displacements[kind][is_high], axis=1).mean()
            > 5 * np.linalg.norm(displacements[kind][is_low], axis=1).mean()
        )
    assert (displacements["subsidence"][:, 2] <= 0).all()
    assert (
        np.mean(displacements["subsidence"][:, 2] < 0.1 * displacements["subsidence"][:, 2].min()) < 0.5
    )  # it is local
    is_end = np.abs(points[:, 0]) > 50
    assert (
        np.abs(displacements["drift"][is_end]).mean()
        > 20 * np.abs(displacements["drift"][np.abs(points[:, 0]) < 10]).mean()
    )


def test_drift_follows_the_longer_axis():
    points = hills_cloud().points
    rotated_points = similarity_from_angles((0, 0, 90), (0, 0, 0), 1).apply(points)
    displacement, rotated_displacement = (make_warp("drift", p, RMS).displacement(p) for p in (points, rotated_points))
    np.testing.assert_allclose(
        np.abs(displacement[:, 2]), np.abs(rotated_displacement[:, 2]), atol=1e-3
    )  # the axis follows the points


@pytest.mark.parametrize("kind", KINDS)
def test_normals_stay_normal_to_the_surface(kind):
    cloud = hills_cloud(300)
    warp = make_warp(kind, cloud.points, 1.5, similarity_from_angles((10, -20, 70), (3, 4, 5), 1.3))
    warped_cloud = warp.apply_cloud(cloud)
    np.testing.assert_allclose(np.linalg.norm(warped_cloud.normals, axis=1), 1, atol=1e-9)
    for direction in ([1, 0, 0.3], [0.2, 1, -0.4]):  # tangents stay tangents
        tangent = np.cross(cloud.normals, direction) * 1e-5
        warped_tangent = warp.apply(cloud.points + tangent) - warp.apply(cloud.points - tangent)
        cosines = np.einsum("ni,ni->n", warped_tangent, warped_cloud.normals) / np.linalg.norm(warped_tangent, axis=1)
        assert np.abs(cosines).max() < 1e-5  # differences of coordinates of 100 over 1e-5


def test_displacements_far_from_the_origin():
    offset = np.array([468_012.25, 5_428_771.5, 312.0])
    near_points, far_points = hills_cloud().points, hills_cloud(offset=offset).points
    for kind in KINDS:
        near_displacement, far_displacement = (
            make_warp(kind, p, RMS).displacement(p) for p in (near_points, far_points)
        )
        np.testing.assert_allclose(near_displacement, far_displacement, atol=1e-7)  # float64 at 5e6 m is good to 1e-9 m


def test_shear_by_height_of_a_flat_cloud_is_refused():
    flat_points = hills_cloud().points * [1, 1, 0]
    for kind in ("shear", "twist"):
        with check_error():
            make_warp(kind, flat_points, RMS)
    residual = affine_residual(flat_points[:, :2], make_warp("dome", flat_points, RMS).apply(flat_points))
    assert np.sqrt(np.square(residual).sum(axis=1).mean()) == pytest.approx(RMS, rel=1e-9)


# ---- the command ----


@pytest.fixture
def run(run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_cloud("in.ply", hills_cloud())
    return partial(run, "synth", "warp")


def test_command_writes_a_cloud_and_its_record(run):
    options = ("--kind", "dome", "--rms", "0.1", "--rotate", "1,2,30", "--shift", "10,20,3", "--scale", "1.1")
    code, out, err = run("in.ply", "out.ply", *options)
    assert (code, err) == (0, "")
    assert "dome of 0.1 m RMS" in out
    check_text(out)
    record = json.loads(Path("out.ply.json").read_text())
    cloud, warped_cloud = read_cloud("in.ply"), read_cloud("out.ply")
    np.testing.assert_array_equal(warped_cloud.points, warp_from_record(record).apply(cloud.points))
    similarity = Similarity.from_matrix(record["after"])
    assert similarity.scale == pytest.approx(1.1)
    lower, upper = cloud.points.min(axis=0), cloud.points.max(axis=0)
    np.testing.assert_allclose(
        similarity.motion_at((lower + upper) / 2).shift, [10, 20, 3]
    )  # it turns about its own centre
    residual = affine_residual(cloud.points, similarity.inverse().apply(warped_cloud.points))
    assert np.sqrt(np.square(residual).sum(axis=1).mean()) == pytest.approx(0.1, rel=1e-9)
    np.testing.assert_allclose(
        similarity_from_angles((0, 0, 90), (0, 0, 0), 1).apply(np.eye(3))[0], [0, 1, 0], atol=1e-15
    )


@pytest.mark.parametrize(("about", "center"), [("origin", [0, 0, 0]), ("5,-6,700", [5, -6, 700])])
def test_rotation_about_the_requested_point(run, about, center):
    assert run("in.ply", "out.ply", "--kind", "dome", "--rms", "0.1", "--rotate", "0,0,30", "--about", about)[0] == 0
    record = json.loads(Path("out.ply.json").read_text())
    motion = Similarity.from_matrix(record["after"]).motion_at(center)
    np.testing.assert_allclose(motion.shift, 0, atol=1e-12)
    assert motion.angle_deg == pytest.approx(30)
    np.testing.assert_array_equal(
        read_cloud("out.ply").points, warp_from_record(record).apply(read_cloud("in.ply").points)
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("in.ply out.ply --kind wave --rms 1", "choose one of dome"),
        ("in.ply out.ply --kind dome --rms 0", "positive RMS"),
        ("in.ply out.ply --kind dome --rms nan", "positive RMS"),
        ("in.ply out.ply --kind dome --rms 1 --rotate 1,2", "three numbers"),
        ("in.ply out.ply --kind dome --rms 1 --about middle", "three numbers"),
        ("in.ply out.ply --kind dome --rms 1 --about 0,0,nan", "--about as three numbers"),
        ("in.ply out.ply --kind dome --rms 1 --shift 1e400,0,0", "--shift as three numbers"),
        ("in.ply out.ply --kind dome --rms 1 --scale 0", "positive scale"),
        ("in.ply in.ply --kind dome --rms 1", "would replace an input"),
        ("no.ply out.ply --kind dome --rms 1", "no.ply"),
        ("in.ply no/out.ply --kind dome --rms 1", "existing folder"),
        ("in.ply out.docx --kind dome --rms 1", "out.docx"),
        ("in.ply out.ply --rms 1", "--kind"),
    ],
)
def test_invalid_arguments_give_a_one_line_error_and_write_nothing(run, tmp_path, arguments, message):
    code, out, err = run(*arguments.split())
    assert code == 2
    assert not out
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert [p.name for p in tmp_path.iterdir()] == ["in.ply"]
