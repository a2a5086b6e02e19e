"""Frames and windows of pictures, and points drawn as images."""

import re

import numpy as np
import pytest
from camera_rigs import nadir, random_rotation, ring, rotated, sector, walk
from optional import import_or_skip

from pcbench import Cloud
from pcbench.report.colors import Range
from pcbench.report.figures import Figures
from pcbench.report.plot.maps import frame
from pcbench.report.plot.rounding import log_ticks, round_length
from pcbench.report.plot.sections import Section, draw_section
from pcbench.report.plot.splats import Backdrop, splat
from pcbench.report.plot.views import AxisBox, Frame, Viewpoint, oblique_view, suitable_views
from pcbench.report.viewing import ViewingCameras

BACKGROUND = np.array([10, 20, 30], np.uint8)
TOP_VIEW = Viewpoint("from above", (0, 0, 1), (0, 1, 0))
NOTHING = np.zeros((0, 3))


def cube(size, *, at=(0.0, 0.0, 0.0), points=5000, seed=0):
    return Cloud(np.random.default_rng(seed).uniform(-0.5, 0.5, (points, 3)) * size + np.array(at))


def test_the_frame_is_that_of_the_measured_region():
    reference, candidate = cube([10, 20, 4]), cube([10, 20, 4], seed=1)
    result = frame(reference, {"good": candidate})
    np.testing.assert_allclose(result.box.high - result.box.low, [11, 22, 4.4], rtol=0.03)
    above = result.sizes[0]
    assert above[0] / above[1] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("distant_cloud", [cube([500, 500, 500], seed=2), cube([10, 20, 4], at=(300, 0, 0), seed=3)])
def test_a_distant_candidate_does_not_change_the_frame(distant_cloud):
    reference, candidate = cube([10, 20, 4]), cube([10, 20, 4], seed=1)
    frame_alone, frame_with_far = (
        frame(reference, {"good": candidate}),
        frame(reference, {"good": candidate, "far": distant_cloud}),
    )
    np.testing.assert_array_equal(frame_alone.windows, frame_with_far.windows)


def test_the_frame_extends_by_at_most_a_quarter_beyond_the_reference():
    reference, wider = cube([10, 20, 4]), cube([13, 20, 4], seed=1)
    result = frame(reference, {"wider": wider})
    assert result.box.high[0] > 6.4
    clipped_frame = frame(reference, {"wider": cube([18, 20, 4], seed=1)})
    assert clipped_frame.box.high[0] == pytest.approx(5.5 + 0.25 * 11, rel=0.03)


def test_the_frame_of_a_wall_contains_a_cloud_in_front_of_it():
    wall = Cloud(cube([10, 0, 5]).points)
    result = frame(wall, {"moved": Cloud(wall.points + [0, 0.3, 0])})
    assert result.box.share(wall.points + [0, 0.3, 0]) > 0.9


def test_outliers_do_not_widen_the_frame():
    points = np.concatenate([cube([10, 10, 10]).points, [[1e5, 0, 0], [0, -1e6, 0]]])
    assert AxisBox.around(points).high.max() < 6


def test_flat_and_single_point_clouds_have_finite_windows():
    wall = cube([10, 0, 4]).points
    assert (Frame.of(AxisBox.around(wall), [wall]).sizes > 0.1).all()
    point = np.zeros((1, 3))
    assert np.isfinite(Frame.of(AxisBox.around(point), [point]).windows).all()
    assert (Frame.of(AxisBox.around(point), [point]).sizes > 0).all()


@pytest.mark.parametrize("shape", [[40, 50, 6], [40, 2, 20], [3, 4, 9]], ids=["town", "wall", "tower"])
def test_views_are_rotations_with_a_horizontal_width(shape):
    for view in suitable_views(cube(shape).points, has_north=True):
        np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.axes) == pytest.approx(1)
        assert view.axes[0, 2] == pytest.approx(0, abs=1e-12)  # lengths along the picture's width are true


@pytest.mark.parametrize(
    ("shape", "has_north", "titles"),
    [
        ([40, 50, 6], True, ["from above", "from the south-west", "from the north-east"]),
        ([40, 50, 6], False, ["from above", "from −x, −y", "from +x, +y"]),
        ([3, 4, 9], True, ["from the south", "from the east", "from the north"]),
        ([3, 4, 9], False, ["from −y", "from +x", "from +y"]),
        ([40, 2, 20], True, ["front", "from the left", "from the right"]),
    ],
)
def test_views_suit_the_shape_of_the_scene(shape, has_north, titles):
    assert [view.title for view in suitable_views(cube(shape).points, has_north=has_north)] == titles


@pytest.mark.parametrize("angle_deg", [0, 30, 100, 170])
def test_a_wall_is_seen_along_its_normal(angle_deg):
    angle = np.radians(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    front, left, right = suitable_views(cube([40, 1, 20]).points @ turn.T, has_north=False)
    normal = turn @ [0, 1, 0]
    assert abs(np.array(front.direction) @ normal) == pytest.approx(1, abs=0.02)
    assert front.direction[1] <= 0.02  # from the side of lower y
    # The left view is turned towards the picture's left.
    assert np.array(left.direction) @ front.axes[0] < -0.5 < 0.5 < np.array(right.direction) @ front.axes[0]


@pytest.mark.parametrize(
    ("max_length", "length"), [(1.0, 1.0), (0.99, 0.5), (49.0, 20.0), (5.0, 5.0), (0.0021, 0.002), (7e5, 5e5)]
)
def test_scale_bars_have_round_lengths(max_length, length):
    assert round_length(max_length) == pytest.approx(length)


@pytest.mark.parametrize(
    ("low", "high", "values"),
    [
        (0.0239, 0.045, [0.025, 0.03, 0.035, 0.04, 0.045]),
        (0.003, 0.06, [0.005, 0.01, 0.02, 0.05]),
        (0.0008, 30, [0.001, 0.01, 0.1, 1, 10]),
        (1.0, 1.01, [1.0, 1.002, 1.004, 1.006, 1.008, 1.01]),
    ],
)
def test_logarithmic_axes_have_few_round_ticks(low, high, values):
    assert log_ticks(low, high) == pytest.approx(values)


def test_a_point_is_drawn_as_a_round_dot_at_its_position():
    window = np.array([[-5.0, -4.0], [5.0, 4.0]])
    image = splat(
        np.array([[2.0, 1.0, 7.0]]), np.array([[200, 100, 50]], np.uint8), TOP_VIEW, window, (100, 80), BACKGROUND
    )
    assert image.shape == (80, 100, 3)
    is_drawn = (image != BACKGROUND).any(axis=2)
    rows, columns = np.nonzero(is_drawn)
    assert columns.mean() == pytest.approx(10 * (2 + 5), abs=1)
    assert rows.mean() == pytest.approx(10 * (4 - 1), abs=1)
    assert image[30, 70].tolist() == [200, 100, 50]
    assert np.ptp(rows) == np.ptp(columns) < 12  # round


def test_nearer_points_hide_others_and_points_outside_are_not_drawn():
    window = np.array([[-1.0, -1.0], [1.0, 1.0]])
    points = np.array([[0, 0, 1.0], [0, 0, 5.0], [0, 0, 3.0], [9, 0, 9], [0.999, 0.999, 0]])
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9], [1, 2, 3]], np.uint8)
    for order in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0]):
        image = splat(points[order], colors[order], TOP_VIEW, window, (40, 40), BACKGROUND)
        assert image[20, 20].tolist() == [0, 255, 0]
    empty_image = splat(points[3:4], colors[3:4], TOP_VIEW, window, (40, 40), BACKGROUND)
    assert (empty_image == BACKGROUND).all()


def test_a_map_of_a_rough_surface_shows_both_sides_equally():
    """From above, points above the surface hide those below it, which would suggest a vertical offset."""
    rng = np.random.default_rng(0)
    height = rng.normal(0, 0.02, 200_000)
    points = np.column_stack([rng.uniform(-10, 10, (200_000, 2)), height])
    colors = np.where(height[:, None] > 0, 200, 100).astype(np.uint8) * np.ones(3, np.uint8)
    window = np.array([[-10.0, -10], [10, 10]])
    backdrop = Backdrop.of(NOTHING, TOP_VIEW, window, (200, 200), BACKGROUND)
    image = splat(points, colors, TOP_VIEW, window, (200, 200), BACKGROUND, backdrop=backdrop)
    assert image.mean() == pytest.approx(150, abs=3)
    own_colors_image = splat(points, colors, TOP_VIEW, window, (200, 200), BACKGROUND)
    assert own_colors_image.mean() > 170  # without a backdrop, points above the surface hide those below


def test_a_backdrop_shows_the_scene_behind_few_points_and_shades_them():
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-10, 10, (100_000, 2)), np.zeros(100_000)])
    ground[(np.abs(ground[:, :2]) < 3).all(axis=1), 2] = 8.0  # a tower
    window, size = np.array([[-9.0, -9], [9, 9]]), (180, 180)
    backdrop = Backdrop.of(ground, TOP_VIEW, window, size, BACKGROUND)
    few = np.array([[-7.0, 7.0, 0.1], [3.1, 0.0, 0.1]])
    colors = np.full((2, 3), 200, np.uint8)
    image = splat(few, colors, TOP_VIEW, window, size, BACKGROUND, backdrop=backdrop)
    assert (image != BACKGROUND).any(axis=2).all()  # the backdrop has no gaps
    level, at_wall = image[20, 20], image[90, 121]
    assert level.tolist() == [200, 200, 200]
    assert (at_wall > 0.5 * 200).all() and (at_wall < 0.8 * 200).all()  # darker, and still readable


def test_shading_darkens_edges_but_not_level_ground():
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-10, 10, (100_000, 2)), np.zeros(100_000)])
    tower = flat.copy()
    tower[(np.abs(flat[:, :2]) < 3).all(axis=1), 2] = 8.0
    grey = np.full((100_000, 3), 180, np.uint8)
    window = np.array([[-9.0, -9], [9, 9]])
    flat_image = splat(flat, grey, TOP_VIEW, window, (180, 180), BACKGROUND)
    tower_image = splat(tower, grey, TOP_VIEW, window, (180, 180), BACKGROUND)
    assert np.median(flat_image) == 180
    assert tower_image[90, 55:61].min() < 120  # the ground to the left of the tower
    assert np.median(tower_image[80:100, 80:100]) == 180


def test_outliers_do_not_slow_drawing():
    points = np.concatenate([cube([2, 2, 2]).points, [[1e12, 0, 0], [0, -1e12, 1e12]]])
    image = splat(
        points, np.full((len(points), 3), 99, np.uint8), TOP_VIEW, np.array([[-1.0, -1], [1, 1]]), (50, 50), BACKGROUND
    )
    assert (image != BACKGROUND).any(axis=2).mean() > 0.5


def test_a_section_goes_through_the_place_of_the_largest_deviations():
    rng = np.random.default_rng(0)
    reference = np.column_stack([rng.uniform(0, 100, (50_000, 2)), np.zeros(50_000)])
    points = np.column_stack([rng.uniform(0, 100, (20_000, 2)), np.zeros(20_000)])
    is_raised = (np.abs(points[:, :2] - [70, 20]) < 4).all(axis=1)
    points[is_raised, 2] = 0.5
    points[0], values = [5, 90, 0], points[:, 2].copy()
    values[0] = 50.0  # a single outlier is not a place
    found = Section.through_worst_place(points, values, reference, spacing=0.3)
    assert np.abs(found.center[:2] - [70, 20]).max() < 5
    across = np.array([-found.direction[1], found.direction[0]])
    for cloud, rows in ((points, found.rows), (reference, found.reference_rows)):
        along = (cloud[:, :2] - found.center[:2]) @ found.direction
        expected = (np.abs((cloud[:, :2] - found.center[:2]) @ across) <= found.thickness / 2) & (
            (found.ends[0] <= along) & (along <= found.ends[1])
        )
        np.testing.assert_array_equal(rows, np.flatnonzero(expected))
    assert is_raised[found.rows].any()
    assert len(found.rows) + len(found.reference_rows) >= 400


def test_a_section_at_the_border_stays_inside_the_scene():
    rng = np.random.default_rng(1)
    reference = np.column_stack([rng.uniform(0, 100, (50_000, 2)), np.zeros(50_000)])
    values = np.where((reference[:, :2] > 96).all(axis=1), 1.0, 0.0)
    found = Section.through_worst_place(reference, values, reference, spacing=0.3)
    ends = found.center[:2] + np.outer(found.ends, found.direction)
    assert (ends > -6).all() and (ends < 106).all()
    assert found.ends[0] < 0 < found.ends[1]
    assert found.length > 20


@pytest.mark.parametrize("angle_deg", [30, pytest.param(100, marks=pytest.mark.long)])
def test_a_section_of_a_wall_is_perpendicular_to_it(angle_deg, tmp_path, monkeypatch):
    import_or_skip("matplotlib")
    angle = np.radians(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    flat = np.random.default_rng(0).uniform([0, 0, 0], [20, 0.02, 8], (40_000, 3))
    off = np.where((np.abs(flat[:, [0, 2]] - [14, 5]) < 1).all(axis=1), 0.3, 0.0)
    reference, points = (
        flat @ turn.T + [446_123, 5_380_456, 410] for flat in (flat, flat + [[0, 1, 0]] * off[:, None])
    )
    found, choose = [], Section.through_worst_place

    def spy(*arguments):
        found.append((choose(*arguments), *arguments))
        return found[-1][0]

    monkeypatch.setattr(Section, "through_worst_place", spy)
    path, scale = tmp_path / "section.svg", Range(0.0, 0.3)
    assert draw_section(points, off, reference, 0.03, "a", scale, "distance [m]", "m", path, Figures())
    section, turned = found[0][:2]
    depths = section.positions(turned[section.rows])[:, 1]
    assert np.ptp(depths) == pytest.approx(0.31, abs=0.02)  # the whole depth of the wall and of the bump
    assert section.length > 4
    text = path.read_text(encoding="utf-8")
    assert "the section, from the front" in text and "towards the viewer [m]" in text
    center = np.array([float(x.replace(",", "")) for x in re.findall(r"[xyz] = ([\d,.]+?)(?=[, ]+[yz\[])", text)])
    assert np.abs(center - (turn @ [14, 0.2, 5] + [446_123, 5_380_456, 410])).max() < 1.2


def test_clouds_that_are_too_sparse_have_no_section():
    points = np.eye(3)
    assert Section.through_worst_place(points, np.ones(3), points, spacing=1.0) is None


def azimuths_deg(views):
    """Return the directions towards the viewer of oblique views, anticlockwise from +x."""
    directions = [view.direction for view in views if view.direction[0] or view.direction[1]]
    return [round(float(np.degrees(np.arctan2(y, x))) % 360, 6) for x, y, _ in directions]


@pytest.mark.parametrize("shape", [[40, 50, 6], [40, 2, 20], [3, 4, 9]], ids=["town", "wall", "tower"])
@pytest.mark.parametrize("has_north", [False, True])
def test_cameras_all_around_or_above_keep_the_usual_views(shape, has_north):
    points = cube(shape).points
    usual = suitable_views(points, has_north=has_north)
    for rig in (ring(), nadir(), ring(4, start_deg=45)):
        assert suitable_views(points, has_north=has_north, cameras=ViewingCameras.of(rig)) == usual


@pytest.mark.parametrize(
    ("shape", "has_north", "titles", "azimuths"),
    [
        ([40, 50, 6], False, ["from above", "from the left", "from the right"], [0, 90]),
        ([40, 50, 6], True, ["from above", "from the east", "from the north"], [0, 90]),
        ([3, 4, 9], False, ["front", "from the left", "from the right"], [45, 0, 90]),
        ([3, 4, 9], True, ["front", "from the left", "from the right"], [45, 0, 90]),
    ],
)
def test_a_scene_is_seen_from_the_side_of_its_cameras(shape, has_north, titles, azimuths):
    views = suitable_views(cube(shape).points, has_north=has_north, cameras=ViewingCameras.of(sector(5, 85)))
    assert [view.title for view in views] == titles
    assert azimuths_deg(views) == pytest.approx(azimuths, abs=1e-3)


def test_two_groups_of_cameras_are_seen_from_where_they_are():
    both = ViewingCameras.of([*sector(-20, 20), *sector(160, 200)])
    views = suitable_views(cube([40, 50, 6]).points, has_north=True, cameras=both)
    assert [view.title for view in views] == ["from above", "from the east", "from the west"]


@pytest.mark.parametrize("angle_deg", [0, 30, 100, 170, 200, 290])
def test_the_front_of_a_wall_is_the_side_of_the_cameras(angle_deg):
    angle = np.radians(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    points = cube([40, 1, 20]).points @ turn.T
    views = suitable_views(points, has_north=False, cameras=ViewingCameras.of(rotated(walk(), turn)))
    assert [view.title for view in views] == ["front", "from the left", "from the right"]
    assert np.array(views[0].direction) @ turn @ [0, -1, 0] == pytest.approx(1, abs=0.01)
    # The left view is turned towards the left of who stands in front.
    assert np.array(views[1].direction) @ turn @ [-1, 0, 0] > 0.5


def test_level_cameras_show_the_front_of_a_yard():
    points = np.concatenate([cube([20, 1, 8]).points, cube([20, 12, 0.1], at=(0, -6, -4)).points])
    views = suitable_views(points, has_north=False, cameras=ViewingCameras.of(walk()))
    assert [view.title for view in views] == ["front", "from the left", "from the right"]
    assert azimuths_deg(views) == pytest.approx([270, 225, 315], abs=0.5)


def test_cameras_without_an_up_direction_change_nothing():
    cameras = ViewingCameras.of(walk())
    unknown = ViewingCameras(cameras.centers, cameras.directions, None)
    points = cube([40, 50, 6]).points
    assert suitable_views(points, has_north=False, cameras=unknown) == suitable_views(points, has_north=False)
    assert oblique_view(unknown).direction == pytest.approx(oblique_view(None).direction)


@pytest.mark.parametrize("rig", [walk(), sector(-130, -50), ring()], ids=["walk", "sector", "ring"])
def test_the_oblique_view_has_up_and_the_side_of_the_cameras(rig):
    turn = random_rotation(4)
    view = oblique_view(ViewingCameras.of(rotated(rig, turn)))
    np.testing.assert_allclose(turn.T @ view.up, [0, 0, 1], atol=1e-9)
    direction = turn.T @ np.array(view.direction) / np.linalg.norm(view.direction)
    assert np.degrees(np.arcsin(direction[2])) == pytest.approx(38, abs=1)
    nearest = max(-camera.cam_from_world.rotation[2, :2] @ direction[:2] for camera in rig)
    assert nearest > 0.3  # some camera looks from about there
