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


def hills(count=4000, seed=0, offset=(0, 0, 0)):
    """Return points of z = 8 sin(x / 15) cos(y / 11) over 120 x 70, with normals."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, count)) * [[60], [35]]
    z = 8 * np.sin(x / 15) * np.cos(y / 11)
    slopes = 8 / 15 * np.cos(x / 15) * np.cos(y / 11), -8 / 11 * np.sin(x / 15) * np.sin(y / 11)
    normals = np.stack([-slopes[0], -slopes[1], np.ones(count)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(np.stack([x, y, z], axis=1) + offset, normals=normals, unit="m")


def beyond_affine(before, after):
    """Return the residual (N, 3) of the best affine map before -> after, by the normal equations."""
    design = np.column_stack([before - before.mean(axis=0), np.ones(len(before))])
    return after - design @ np.linalg.solve(design.T @ design, design.T @ after)


def again(record):
    after = Similarity.from_matrix(record["after"])
    rest = (np.array(record[key]) for key in ("centre", "axes", "lengths"))
    return Warp(record["kind"], record["amplitude"], *rest, after)


@pytest.mark.parametrize("kind", KINDS)
def test_the_amplitude_is_beyond_any_affine_map(kind):
    cloud = hills()
    warp = make_warp(kind, cloud.points, RMS)
    moved = warp.apply(cloud.points)
    rest = beyond_affine(cloud.points, moved)
    assert np.sqrt(np.square(rest).sum(axis=1).mean()) == pytest.approx(RMS, rel=1e-9)
    record = json.loads(json.dumps(warp.record(cloud.points)))
    assert record["rms_beyond_affine"] == pytest.approx(RMS, rel=1e-9)
    assert record["max_beyond_affine"] == pytest.approx(np.linalg.norm(rest, axis=1).max())
    np.testing.assert_array_equal(again(record).apply(cloud.points), moved)
    # The affine part is the displacement without the residual.
    matrix = np.array(record["affine_part"])
    np.testing.assert_allclose(Affine(matrix[:3, :3], matrix[:3, 3]).apply(cloud.points), moved - rest, atol=1e-9)


def test_what_each_kind_does():
    points = hills().points
    moved = {kind: make_warp(kind, points, RMS).displacement(points) for kind in KINDS}
    r = np.hypot(points[:, 0] - moved["dome"][:, 0], points[:, 1])
    for kind in ("dome", "bowl", "subsidence"):
        np.testing.assert_allclose(moved[kind][:, :2], 0, atol=1e-15)
    inner, outer = r < 15, r > 50
    assert moved["dome"][inner, 2].mean() > moved["dome"][outer, 2].mean()
    np.testing.assert_allclose(moved["bowl"], -moved["dome"])
    high, low = points[:, 2] > 5, np.abs(points[:, 2]) < 0.5
    for kind in ("shear", "twist"):
        np.testing.assert_allclose(moved[kind][:, 2], 0, atol=1e-15)
        assert np.linalg.norm(moved[kind][high], axis=1).mean() > 5 * np.linalg.norm(moved[kind][low], axis=1).mean()
    assert (moved["subsidence"][:, 2] <= 0).all()
    assert np.mean(moved["subsidence"][:, 2] < 0.1 * moved["subsidence"][:, 2].min()) < 0.5  # it is local
    ends = np.abs(points[:, 0]) > 50
    assert np.abs(moved["drift"][ends]).mean() > 20 * np.abs(moved["drift"][np.abs(points[:, 0]) < 10]).mean()


def test_strips_drift_along_themselves():
    points = hills().points
    turned = similarity_from_angles((0, 0, 90), (0, 0, 0), 1).apply(points)
    one, two = (make_warp("drift", p, RMS).displacement(p) for p in (points, turned))
    np.testing.assert_allclose(np.abs(one[:, 2]), np.abs(two[:, 2]), atol=1e-3)  # the axis follows the points


@pytest.mark.parametrize("kind", KINDS)
def test_normals_turn_with_the_surface(kind):
    cloud = hills(300)
    warp = make_warp(kind, cloud.points, 1.5, similarity_from_angles((10, -20, 70), (3, 4, 5), 1.3))
    moved = warp.apply_cloud(cloud)
    np.testing.assert_allclose(np.linalg.norm(moved.normals, axis=1), 1, atol=1e-9)
    for direction in ([1, 0, 0.3], [0.2, 1, -0.4]):  # tangents stay tangents
        tangent = np.cross(cloud.normals, direction) * 1e-5
        carried = warp.apply(cloud.points + tangent) - warp.apply(cloud.points - tangent)
        cosines = np.einsum("ni,ni->n", carried, moved.normals) / np.linalg.norm(carried, axis=1)
        assert np.abs(cosines).max() < 1e-5  # differences of coordinates of 100 over 1e-5


def test_far_from_the_origin():
    offset = np.array([468_012.25, 5_428_771.5, 312.0])
    near, far = hills().points, hills(offset=offset).points
    for kind in KINDS:
        one, two = (make_warp(kind, p, RMS).displacement(p) for p in (near, far))
        np.testing.assert_allclose(one, two, atol=1e-7)  # float64 at 5e6 m is good to 1e-9 m


def test_a_flat_cloud_cannot_be_sheared_by_height():
    flat = hills().points * [1, 1, 0]
    for kind in ("shear", "twist"):
        with check_error():
            make_warp(kind, flat, RMS)
    rest = beyond_affine(flat[:, :2], make_warp("dome", flat, RMS).apply(flat))
    assert np.sqrt(np.square(rest).sum(axis=1).mean()) == pytest.approx(RMS, rel=1e-9)


# ---- the command ----


@pytest.fixture
def run(run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_cloud("in.ply", hills())
    return partial(run, "synth", "warp")


def test_the_command_and_its_record(run):
    options = ("--kind", "dome", "--rms", "0.1", "--rotate", "1,2,30", "--shift", "10,20,3", "--scale", "1.1")
    code, out, err = run("in.ply", "out.ply", *options)
    assert (code, err) == (0, "")
    assert "0.1 RMS" in out
    check_text(out)
    record = json.loads(Path("out.ply.json").read_text())
    before, after = read_cloud("in.ply"), read_cloud("out.ply")
    np.testing.assert_array_equal(after.points, again(record).apply(before.points))
    T = Similarity.from_matrix(record["after"])
    assert T.scale == pytest.approx(1.1)
    low, high = before.points.min(axis=0), before.points.max(axis=0)
    np.testing.assert_allclose(T.motion_at((low + high) / 2).shift, [10, 20, 3])  # it turns about its own centre
    rest = beyond_affine(before.points, T.inverse().apply(after.points))
    assert np.sqrt(np.square(rest).sum(axis=1).mean()) == pytest.approx(0.1, rel=1e-9)
    np.testing.assert_allclose(
        similarity_from_angles((0, 0, 90), (0, 0, 0), 1).apply(np.eye(3))[0], [0, 1, 0], atol=1e-15
    )


@pytest.mark.parametrize(("about", "place"), [("origin", [0, 0, 0]), ("5,-6,700", [5, -6, 700])])
def test_it_rotates_about_the_requested_point(run, about, place):
    assert run("in.ply", "out.ply", "--kind", "dome", "--rms", "0.1", "--rotate", "0,0,30", "--about", about)[0] == 0
    record = json.loads(Path("out.ply.json").read_text())
    motion = Similarity.from_matrix(record["after"]).motion_at(place)
    np.testing.assert_allclose(motion.shift, 0, atol=1e-12)
    assert motion.angle_deg == pytest.approx(30)
    np.testing.assert_array_equal(read_cloud("out.ply").points, again(record).apply(read_cloud("in.ply").points))


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
def test_mistakes_are_one_line_and_leave_nothing(run, tmp_path, arguments, message):
    code, out, err = run(*arguments.split())
    assert code == 2
    assert not out
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert [p.name for p in tmp_path.iterdir()] == ["in.ply"]
