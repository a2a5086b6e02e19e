"""Cloud: validation, selection, transforms, conversions, and each refusal."""

import dataclasses

import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.errors import MissingExtra, PcbenchError
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.transform import Affine, Similarity
from pcbench.io import read_cloud, write_cloud

POINTS = np.arange(12.0).reshape(4, 3)
QUARTER_TURN = Similarity(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 0, 0]), 2.0)


def full_cloud():
    return Cloud(
        POINTS,
        normals=np.tile([1.0, 0, 0], (4, 1)),
        colors=np.arange(12, dtype=np.uint8).reshape(4, 3),
        attributes={"intensity": np.arange(4), "rot_0": np.ones(4), "scale_2": np.ones(4), "f_rest_44": np.ones(4)},
        crs="EPSG:25832",
        unit="m",
    )


def test_points_are_float64_in_c_order():
    for array in (POINTS.astype(np.float32), POINTS.tolist(), np.asfortranarray(POINTS), POINTS.astype(">f8")):
        points = Cloud(array).points
        assert points.dtype == np.float64
        assert points.dtype.isnative
        assert points.flags.c_contiguous
        assert (points == POINTS).all()


def test_length_bounds_and_representation():
    cloud = full_cloud()
    assert len(cloud) == 4
    assert [corner.tolist() for corner in cloud.bounds] == [[0, 1, 2], [9, 10, 11]]
    check_text(repr(cloud), masked=False)
    check_text(repr(Cloud(POINTS)), masked=False)


def test_clouds_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        full_cloud().points = POINTS


@pytest.mark.parametrize("selection", [np.array([True, False, False, True]), np.array([0, 3])])
def test_select_applies_to_all_fields(selection):
    selected = full_cloud().select(selection)
    assert selected.points.tolist() == [[0, 1, 2], [9, 10, 11]]
    assert selected.normals.shape == (2, 3)
    assert selected.colors.tolist() == [[0, 1, 2], [9, 10, 11]]
    assert selected.attributes["intensity"].tolist() == [0, 3]
    assert (selected.crs, selected.unit) == ("EPSG:25832", "m")


def test_select_may_reorder_and_repeat():
    assert full_cloud().select(np.array([3, 3, 0])).attributes["intensity"].tolist() == [3, 3, 0]


def test_select_of_a_cloud_without_attributes():
    selected = Cloud(POINTS).select(np.array([1]))
    assert selected.normals is None
    assert selected.colors is None


def test_transforms_apply_to_points_and_normals():
    cloud = full_cloud()
    moved = cloud.transformed(QUARTER_TURN)
    assert moved.points[1].tolist() == [10 - 2 * 4, 2 * 3, 2 * 5]
    assert moved.normals[0].tolist() == [0, 1, 0]
    assert moved.colors is cloud.colors
    assert list(moved.attributes) == ["intensity"]  # attributes in the splat's axes are dropped
    assert (cloud.points == POINTS).all()  # the original is unchanged
    assert len(cloud.attributes) == 4


def test_transformed_by_an_affine_map():
    # Stretching x by 2 turns the plane x + y = const, and with it the normal, towards y.
    cloud = Cloud(POINTS, normals=np.tile([1.0, 1.0, 0.0], (4, 1)))
    moved = cloud.transformed(Affine(np.diag([2.0, 1, 1]), np.zeros(3)))
    expected = np.sqrt(2) * np.array([0.5, 1, 0]) / np.sqrt(1.25)
    np.testing.assert_allclose(moved.normals, np.tile(expected, (4, 1)), rtol=1e-15)


def test_as_cloud():
    cloud = full_cloud()
    assert as_cloud(cloud) is cloud
    assert (as_cloud(POINTS).points == POINTS).all()


@pytest.mark.parametrize("make", [Cloud, Cloud.from_finite])
def test_overflowing_sums_raise_and_are_not_dropped_as_infinite(make):
    with check_error():
        make(np.full((3, 3), 1.7e308))


def test_from_finite_drops_rows_of_all_fields():
    points = POINTS.copy()
    points[1, 2], points[2, 0] = np.nan, -np.inf
    colors = np.arange(12).reshape(4, 3)
    cloud, dropped = Cloud.from_finite(
        points, normals=POINTS, colors=colors.tolist(), attributes={"a": [5, 6, 7, 8]}, unit="ft"
    )
    assert dropped == 2
    assert cloud.points.tolist() == cloud.normals.tolist() == POINTS[[0, 3]].tolist()
    assert cloud.colors.tolist() == colors[[0, 3]].tolist()
    assert cloud.attributes["a"].tolist() == [5, 8]
    assert cloud.unit == "ft"


def test_from_finite_of_finite_points():
    cloud, dropped = Cloud.from_finite(POINTS.tolist(), attributes={"a": np.arange(4)}, normals=None)
    assert dropped == 0
    assert cloud.attributes["a"].tolist() == [0, 1, 2, 3]


NAN = np.full((4, 3), np.nan)
ONE_NAN = np.vstack([POINTS[:3], NAN[:1]])


@pytest.mark.parametrize(
    "make",
    [
        lambda: Cloud(np.empty((0, 3))),
        lambda: Cloud(np.zeros(3)),
        lambda: Cloud(np.zeros((4, 2))),
        lambda: Cloud("cloud.ply"),
        lambda: Cloud([[1, 2, 3], [4, 5]]),
        lambda: Cloud([{}, {}]),
        lambda: Cloud(ONE_NAN),
        lambda: Cloud([[np.inf, 0, 0], [-np.inf, 0, 0]]),
        lambda: Cloud(POINTS, normals=POINTS[:3]),
        lambda: Cloud(POINTS, normals=np.zeros(4)),
        lambda: Cloud(POINTS, colors=np.zeros((4, 4), np.uint8)),
        lambda: Cloud(POINTS, colors=np.full((4, 3), 0.5)),
        lambda: Cloud(POINTS, colors=np.full((4, 3), 256)),
        lambda: Cloud(POINTS, colors=[[-1, 0, 0]] * 4),
        lambda: Cloud(POINTS, colors=NAN),
        lambda: Cloud(POINTS, colors="red"),
        lambda: Cloud(POINTS, attributes={"a": np.zeros(3)}),
        lambda: Cloud(POINTS, attributes={"a": 1.0}),
        lambda: Cloud.from_finite(NAN),
        lambda: Cloud.from_finite(np.empty((0, 3))),
        lambda: Cloud.from_finite(ONE_NAN, normals=POINTS[:2]),
        lambda: Cloud.from_finite(ONE_NAN, attributes={"a": [1]}),
        lambda: full_cloud().select(np.zeros(4, dtype=bool)),
        lambda: as_cloud(np.zeros((2, 2))),
    ],
)
def test_invalid_clouds_are_refused(make):
    with check_error() as caught:
        make()
    assert isinstance(caught.value, PcbenchError)


def test_whole_colors_of_other_types_are_converted():
    for dtype in (np.uint16, np.int64, np.float32):
        colors = Cloud(POINTS, colors=np.full((4, 3), 255, dtype)).colors
        assert colors.dtype == np.uint8
        assert (colors == 255).all()


def test_clouds_do_not_change_with_the_callers_arrays():
    points, normals = POINTS.copy(), np.tile([1.0, 0, 0], (4, 1))
    colors, intensity = np.zeros((4, 3), np.uint8), np.zeros(4)
    read_only_view = points[:]
    read_only_view.flags.writeable = False
    clouds = [Cloud(array, normals, colors, {"intensity": intensity}) for array in (points, read_only_view)]
    clouds.append(Cloud.from_finite(points, normals=normals, colors=colors, attributes={"intensity": intensity})[0])
    clouds.append(as_cloud(points))
    for array in (points, normals, colors, intensity):
        array += 1
    for cloud in clouds:
        assert (cloud.points == POINTS).all()
    for cloud in clouds[:3]:
        assert (cloud.normals == [1, 0, 0]).all()
        assert not cloud.colors.any()
        assert not cloud.attributes["intensity"].any()


def test_arrays_are_read_only_and_not_copied_again(tmp_path):
    write_cloud(tmp_path / "a.ply", full_cloud())
    clouds = [full_cloud(), read_cloud(tmp_path / "a.ply")]
    clouds += [clouds[0].select(np.array([0, 2])), clouds[0].transformed(QUARTER_TURN), Cloud(POINTS.tolist())]
    for cloud in clouds:
        arrays = [cloud.points, cloud.normals, cloud.colors, *cloud.attributes.values()]
        for array in arrays:
            if array is not None:
                with pytest.raises(ValueError, match="read-only"):
                    array[0] = 0
        replaced = dataclasses.replace(cloud, unit="ft")
        assert replaced.points is cloud.points
        assert all(replaced.attributes[name] is cloud.attributes[name] for name in cloud.attributes)


def test_open3d_round_trip():
    import_or_skip("open3d")
    cloud = full_cloud()
    legacy = Cloud.from_open3d(cloud.to_open3d())
    tensor = Cloud.from_open3d(cloud.to_open3d_tensor())
    for restored in (legacy, tensor):
        assert (restored.points == cloud.points).all()
        assert restored.points.dtype == np.float64
        assert (restored.normals == cloud.normals).all()
        assert (restored.colors == cloud.colors).all()
        assert restored.colors.dtype == np.uint8
    assert not legacy.attributes
    assert sorted(tensor.attributes) == sorted(cloud.attributes)
    assert all((tensor.attributes[name] == cloud.attributes[name]).all() for name in cloud.attributes)
    bare = Cloud.from_open3d(Cloud(POINTS).to_open3d())
    assert (bare.normals, bare.colors) == (None, None)


def test_open3d_round_trip_preserves_every_colour():
    import_or_skip("open3d")
    colors = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    cloud = Cloud(np.zeros((256, 3)), colors=colors)
    assert (Cloud.from_open3d(cloud.to_open3d()).colors == colors).all()
    tensor_cloud = cloud.to_open3d_tensor()
    tensor_cloud.point["colors"] = tensor_cloud.point["colors"].to(tensor_cloud.point["positions"].dtype) / 255
    assert (Cloud.from_open3d(tensor_cloud).colors == colors).all()


def test_a_cloud_from_open3d_is_a_copy():
    open3d = import_or_skip("open3d")
    original = Cloud(POINTS).to_open3d()
    tensor = Cloud(POINTS).to_open3d_tensor()
    clouds = [Cloud.from_open3d(original), Cloud.from_open3d(tensor)]
    original.translate([1.0, 0, 0])
    tensor.translate(open3d.core.Tensor([1.0, 0, 0]))
    for cloud in clouds:
        assert (cloud.points == POINTS).all()


def test_only_nonempty_open3d_clouds_are_converted():
    with check_error():
        Cloud.from_open3d([1, 2])
    open3d = import_or_skip("open3d")
    for empty_cloud in (open3d.geometry.PointCloud(), open3d.t.geometry.PointCloud()):
        with check_error():
            Cloud.from_open3d(empty_cloud)


def test_from_trimesh():
    trimesh = import_or_skip("trimesh")
    colors = np.arange(16, dtype=np.uint8).reshape(4, 4)
    original = trimesh.PointCloud(POINTS.copy(), colors=colors)
    cloud = Cloud.from_trimesh(original)
    original.vertices += 1
    assert (cloud.points == POINTS).all()
    assert (cloud.colors == colors[:, :3]).all()
    assert Cloud.from_trimesh(trimesh.PointCloud(POINTS)).colors is None
    box = trimesh.creation.box()
    assert (Cloud.from_trimesh(box).points == box.vertices).all()
    assert Cloud.from_trimesh(box).colors is None
    box.visual.vertex_colors = np.tile(colors[:1], (8, 1))
    assert (Cloud.from_trimesh(box).colors == colors[0, :3]).all()
    with check_error():
        Cloud.from_trimesh(trimesh.Scene(box))


def test_errors_have_standard_base_classes():
    with check_error(ValueError):
        Cloud(np.zeros((0, 3)))
    assert issubclass(MissingExtra, ImportError)
    check_text(MissingExtra("trimesh", "mesh"))
