"""Pictures of single clouds, and the same pictures whatever the frame of cloud and cameras."""

import numpy as np
import pytest
import shapes
from camera_rigs import nadir, random_rotation, ring, rotated, walk
from optional import break_library, import_or_skip
from wording import check_error

from pcbench import Cloud
from pcbench.errors import MissingExtra
from pcbench.geometry.transform import Similarity
from pcbench.report import Figures
from pcbench.report.plot.classes import classes_of
from pcbench.report.plot.clouds import _range, draw_cloud
from pcbench.report.viewing import ViewingCameras

import_or_skip("matplotlib")

pytestmark = pytest.mark.usefixtures("coarse_pictures")


def facade():
    """A red wall in the plane y = 0, with a green bay at its front (negative y), and a grey floor in front."""
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-10, 10, 20_000), np.zeros(20_000), rng.uniform(-2, 8, 20_000)])
    bay = np.column_stack([rng.uniform(1, 5, 8000), np.full(8000, -2.0), rng.uniform(-2, 3, 8000)])
    floor = np.column_stack([rng.uniform(-10, 10, 10_000), rng.uniform(-5, 0, 10_000), np.full(10_000, -2.0)])
    colors = np.repeat(np.array([[200, 40, 40], [40, 200, 40], [120, 120, 120]], np.uint8), [20_000, 8000, 10_000], 0)
    return Cloud(np.concatenate([wall, bay, floor]), colors=colors)


def town():
    points = shapes.city(20_000, seed=1)[0]
    return Cloud(points, attributes={"height": points[:, 2]})


SCENES = {"facade": (facade, walk()), "town": (town, ring(height=120.0)), "survey": (town, nadir())}


def picture(path, cloud, rig=None, **options):
    from matplotlib.image import imread

    draw_cloud("cloud", cloud, path, Figures(), cameras=None if rig is None else ViewingCameras.of(rig), **options)
    return np.rint(255 * imread(path)[..., :3]).astype(int)


def in_frame(scene, seed):
    """Return cloud and cameras of a scene in a random frame."""
    cloud, rig = SCENES[scene][0](), SCENES[scene][1]
    rotation = random_rotation(seed)
    return cloud.transformed(Similarity(rotation, np.zeros(3))), rotated(rig, rotation)


@pytest.mark.parametrize(
    ("scene", "scalar"),
    [("facade", None), pytest.param("town", "height", marks=pytest.mark.long), ("survey", "height")],
)
def test_pictures_do_not_depend_on_the_frame_of_cloud_and_cameras(scene, scalar, tmp_path):
    one, other = (picture(tmp_path / "a.png", *in_frame(scene, seed), scalar=scalar) for seed in (8, 12))
    assert one.shape == other.shape
    is_equal = np.abs(one - other).max(axis=2) <= 3
    assert is_equal.mean() > 0.995  # rounding moves single points to the next pixel
    without_cameras = picture(tmp_path / "a.png", in_frame(scene, 8)[0], scalar=scalar)
    assert without_cameras.shape != one.shape or (np.abs(one - without_cameras).max(axis=2) > 3).mean() > 0.05


def test_a_facade_has_the_same_picture_with_z_up(tmp_path):
    upright, turned = picture(tmp_path / "a.png", facade(), walk()), picture(tmp_path / "a.png", *in_frame("facade", 8))
    assert upright.shape == turned.shape
    assert (np.abs(upright - turned).max(axis=2) <= 3).mean() > 0.99


def test_the_front_of_a_facade_is_seen_upright(tmp_path):
    image = picture(tmp_path / "a.png", *in_frame("facade", 3))
    front = image[80:-60, : image.shape[1] // 3]
    is_green = (front[..., 1] > 100) & (front[..., 0] < 60)
    is_red = (front[..., 0] > 100) & (front[..., 1] < 60)
    rows, columns = np.nonzero(is_green)
    red_rows, red_columns = np.nonzero(is_red)
    assert len(rows) > 1000 < len(red_rows)
    assert rows.mean() > red_rows.mean() + 20  # the bay is at the lower part of the wall
    assert columns.mean() > red_columns.mean() + 20  # and on the right


def test_heights_are_along_the_up_direction(tmp_path):
    """Without colours, the lowest points have the first colour of the range, in whatever frame."""
    cloud, rig = in_frame("town", 8)
    plain = Cloud(cloud.points)
    one = picture(tmp_path / "a.png", plain, rig)
    heights = SCENES["town"][0]().points[:, 2]
    by_attribute = picture(tmp_path / "b.png", Cloud(cloud.points, attributes={"h": heights}), rig, scalar="h")
    assert one.shape[0] == by_attribute.shape[0]
    assert (one[..., 2] > one[..., 0]).mean() > 0.1  # much ground is violet and blue
    other = picture(tmp_path / "a.png", Cloud(in_frame("town", 12)[0].points), in_frame("town", 12)[1])
    assert (np.abs(one - other).max(axis=2) <= 3).mean() > 0.99


@pytest.mark.parametrize(
    ("values", "ticks"),
    [
        (np.linspace(0, 100, 400), ["0", "80"]),
        (np.linspace(-5, 4, 400), ["−4", "4"]),
        (np.where(np.arange(400) % 2, np.nan, 7.0), []),
        (np.zeros(400), []),
        (np.full(400, -1e9), []),
    ],
)
def test_attributes_of_all_ranges_are_drawn(values, ticks, tmp_path):
    cloud = Cloud(np.random.default_rng(0).uniform(0, 9, (400, 3)), attributes={"value": values})
    draw_cloud("cloud", cloud, tmp_path / "a.svg", Figures(), scalar="value")
    text = (tmp_path / "a.svg").read_text()
    assert ">value<" in text
    for tick in ticks:
        assert f">{tick}<" in text


@pytest.mark.parametrize(
    ("name", "values", "legend"),
    [
        ("classification", np.arange(400, dtype=np.uint8) % 2 + 1, ["1 unclassified", "2 ground"]),
        ("classification", np.where(np.arange(400) % 3, 6.0, np.nan), ["6 building"]),
        ("return number", np.arange(400, dtype=np.uint8) % 4 - 1, ["0", "1", "2", "255"]),
    ],
)
def test_few_integers_have_discrete_colors_with_a_legend(name, values, legend, tmp_path):
    cloud = Cloud(np.random.default_rng(0).uniform(0, 9, (400, 3)), attributes={name: values})
    draw_cloud("cloud", cloud, tmp_path / "a.svg", Figures(), scalar=name)
    text = (tmp_path / "a.svg").read_text()
    assert all(f">{entry}<" in text for entry in (name, *legend))
    draw_cloud("cloud", cloud, tmp_path / "a.svg", Figures(range=9.0), scalar=name)
    assert "range set by the user" in (tmp_path / "a.svg").read_text()


@pytest.mark.parametrize(
    ("values", "is_classified"),
    [(np.arange(400) % 12, True), (np.arange(400) % 13, False), (np.arange(400) % 3 / 2, False)],
)
def test_many_values_and_fractions_have_a_continuous_range(values, is_classified):
    found = classes_of("value", values.astype(float), is_integer=values.dtype.kind == "i")
    assert (found is not None) == is_classified
    assert classes_of("value", values.astype(float), is_integer=False) is None
    if found is not None:
        assert len(np.unique(found.colors(values), axis=0)) == 12


@pytest.mark.parametrize(
    ("values", "note"),
    [
        (np.linspace(0, 1, 400), "up to the 95th percentile"),
        (np.repeat([0.0, 2.0], 200), ""),
        (np.linspace(9, 10, 400), "inner 99 %"),
    ],
)
def test_only_values_beyond_the_range_are_noted(values, note):
    scale = _range(values, None)
    assert (scale.note, scale.is_closed) == (note, not note)
    assert _range(values, 20.0).is_closed
    assert not _range(values, 0.5).is_closed


@pytest.mark.parametrize("points", [[[1.0, 2, 3]], [[k, 0, 0] for k in range(9)], [[2.0, 2, 1e6]] * 30])
def test_points_without_extent_are_drawn(points, tmp_path):
    assert picture(tmp_path / "a.png", Cloud(np.array(points, float))).std() > 0


@pytest.mark.parametrize("name", ["$\\frac{$", "a_b^c$d$", "\u202ename\nline", "<b>&"])
def test_names_with_markup_are_drawn_as_they_are(name, tmp_path):
    cloud = Cloud(np.random.default_rng(0).uniform(0, 9, (400, 3)), attributes={name: np.arange(400.0)})
    draw_cloud(name, cloud, tmp_path / "a.svg", Figures(), scalar=name)
    text = (tmp_path / "a.svg").read_text()
    assert "\u202e" not in text
    assert "<b>" not in text


def test_what_cannot_be_drawn_is_refused(tmp_path):
    cloud = Cloud(np.eye(3), attributes={"a": np.full(3, np.nan), "b": np.ones(3)})
    for scalar in ("c", "a"):
        with check_error():
            draw_cloud("cloud", cloud, tmp_path / "a.png", Figures(), scalar=scalar)
    with check_error():
        draw_cloud("cloud", Cloud(np.eye(3)), tmp_path / "a.png", Figures(), scalar="c")
    assert not list(tmp_path.iterdir())


def test_missing_matplotlib_names_the_extra(monkeypatch, tmp_path):
    break_library(monkeypatch, tmp_path, "matplotlib", None)
    with check_error(MissingExtra):
        draw_cloud("cloud", Cloud(np.eye(3)), tmp_path / "a.png", Figures())
