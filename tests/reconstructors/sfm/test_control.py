"""Control points: reading, measuring, and bundle adjustment with them."""

import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from reconstructors.sfm.alignment import camera_errors
from reconstructors.sfm.control import (
    ControlPoint,
    ControlSurvey,
    Observation,
    adjust,
    measure,
    read_control,
    triangulate,
)
from reconstructors.sfm.model import cameras_of

K = Intrinsics(400, 300, 350, 350, 200, 150, (-0.05, 0.0, 0.0, 0.0))
OFFSET = np.array([450_000.0, 5_400_000.0, 300.0])  # projected coordinates


def test_rays_are_triangulated_to_their_common_point():
    point, centres = np.array([1.0, 2, 3]), np.random.default_rng(0).normal(size=(4, 3))
    rays = (point - centres) / np.linalg.norm(point - centres, axis=1)[:, None]
    np.testing.assert_allclose(triangulate(rays, centres), point, atol=1e-12)


def test_a_mark_outside_its_image_is_refused():
    centres = np.eye(3) * 5
    cameras = {f"{k}.jpg": Camera(f"{k}.jpg", K, look_at(centre, np.zeros(3))) for k, centre in enumerate(centres)}
    point = ControlPoint("A", np.zeros(3), (Observation("0.jpg", 5000.0, 20.0), Observation("1.jpg", 200.0, 150.0)))
    with check_error():
        measure(cameras, [point], 1.0)


def _prepend(path, head):
    path.write_text(head + path.read_text())
    return path


def test_control_files_are_read_and_malformed_ones_refused(tmp_path):
    path = tmp_path / "control.txt"
    path.write_text("# survey\nA 1 2 3 a.jpg 10.5 20\nA 1 2 3 b.jpg 11 21\nB* 4 5 6 a.jpg 1 2\nB* 4 5 6 b.jpg 3 4\n")
    survey = read_control(path)
    a, b = survey.points
    assert survey.control == [a]
    assert not survey.z_is_up
    assert read_control(_prepend(path, "# Z is up.\n")).z_is_up
    assert (a.name, a.is_check, b.is_check) == ("A", False, True)
    np.testing.assert_array_equal(b.position, [4, 5, 6])
    assert a.observations[0] == ("a.jpg", 10.5, 20)
    for text in (
        "A 1 2 3 a.jpg 10",
        "A 1 2 3 a.jpg 1 nan",
        "A 1 2 3 a.jpg 1 2\nA 1 2 4 b.jpg 1 2",
        "A 1 2 3 a.jpg 1 2",
        "A 1 2 3 a.jpg 1 2\nA 1 2 3 a.jpg 1 2\nA 1 2 3 b.jpg 1 2",
        "A 1 2 3 a.jpg 1 2\nA 1 2 3 b.jpg 1 2\nA* 1 2 3 a.jpg 1 2\nA* 1 2 3 b.jpg 1 2",
    ):
        path.write_text(text)
        with check_error():
            read_control(path)
    with check_error():
        read_control(tmp_path / "none.txt")


def simulate_survey():
    """Simulate fifteen error-free vertical images of 300 points with gentle relief."""
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-60, 60, (300, 2)), rng.uniform(-3, 3, 300)])
    cameras = [
        Camera(f"{n}.png", K, look_at([x, y, 100.0], [x, y, 0.0]))
        for n, (x, y) in enumerate((x, y) for x in np.linspace(-50, 50, 5) for y in (-30.0, 0.0, 30.0))
    ]
    return cameras, points


def build_model(cameras, points, intrinsics, bend):
    """Build a COLMAP model of the survey with other intrinsics, deformed by z += bend (1 - r^2 / 60^2)."""
    import pycolmap

    def deform(positions):
        return (
            positions
            + OFFSET
            + np.column_stack([0 * positions[:, :2], bend * (1 - np.square(positions[:, :2] / 60).sum(axis=1))])
        )

    model = pycolmap.Reconstruction()
    parameters = [intrinsics.fx, intrinsics.cx, intrinsics.cy, intrinsics.distortion[0]]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=400, height=300, params=parameters)
    )
    tracks = [pycolmap.Track() for _ in points]
    for number, camera in enumerate(cameras, 1):
        pixels, _ = camera.project(points)
        visible_ids = np.flatnonzero(((pixels > 0) & (pixels < [400, 300])).all(axis=1))
        image = pycolmap.Image(name=camera.name, camera_id=1, image_id=number)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixels[k]) for k in visible_ids])
        rotation, position = camera.cam_from_world.rotation, deform(camera.position[None])[0]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ position))
        for index, k in enumerate(visible_ids):
            tracks[k].add_element(number, index)
    for at, track in zip(deform(points), tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(at, track)
    return model


def make_control_points(cameras, points):
    control = []
    for name, k in zip("ABCDE", np.argsort(np.abs(np.abs(points[:, :2]) - 45).sum(axis=1))[:5], strict=True):
        observations = []
        for camera in cameras:
            (pixel,), _ = camera.project(points[k : k + 1])
            if (pixel > 0).all() and (pixel < [400, 300]).all():
                observations.append(Observation(camera.name, 2 * pixel[0], 2 * pixel[1]))  # in images of twice the size
        control.append(ControlPoint(name, points[k] + OFFSET, tuple(observations)))
    return control


@pytest.mark.parametrize(("refine", "intrinsics"), [("none", K), ("all", Intrinsics(400, 300, 345, 345, 200, 150))])
def test_the_adjustment_removes_a_deformation(refine, intrinsics):
    import_or_skip("pycolmap")
    cameras, points = simulate_survey()
    control = make_control_points(cameras, points)
    model = build_model(cameras, points, intrinsics, bend=2.0)
    before = measure(cameras_of(model), control, 0.5)
    adjusted_model = adjust(model, control, 0.5, refine)
    adjusted_cameras = cameras_of(adjusted_model)
    positions = np.array([np.linalg.norm(adjusted_cameras[c.name].position - OFFSET - c.position) for c in cameras])
    # The images are error-free: only the solver's tolerance and the rounding of 5.4e6 metres remain.
    assert positions.max() < 1e-3
    assert adjusted_cameras["0.png"].intrinsics.distortion[0] == pytest.approx(-0.05, abs=1e-4)
    after = measure(adjusted_cameras, control, 0.5)
    errors = [
        max(np.linalg.norm(m.estimated_position - m.point.position) for m in measured) for measured in (before, after)
    ]
    assert errors[0] > 0.1
    assert errors[1] < 1e-3
    residuals = ControlSurvey(tuple(control)).residuals(adjusted_cameras, 0.5)
    assert [point.name for point in residuals.control] == list("ABCDE")
    assert residuals.rmse(residuals.control).total < 1e-3
    # The control points are not added to the cloud.
    assert len(adjusted_model.points3D) == sum(p.track.length() >= 2 for p in model.points3D.values())
    _, angles = camera_errors(adjusted_cameras, {c.name: c for c in cameras})
    assert angles.max() < 1e-3
