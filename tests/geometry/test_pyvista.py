"""Clouds and meshes copied to pyvista and back."""

import numpy as np
import pytest
from optional import break_library, import_or_skip
from wording import check_error

from pcbench import Cloud, Mesh
from pcbench.errors import MissingExtra

pyvista = import_or_skip("pyvista")


@pytest.fixture
def cloud():
    rng = np.random.default_rng(0)
    return Cloud(
        rng.random((5, 3)) + [500_000, 5_400_000, 0],
        normals=rng.normal(size=(5, 3)),
        colors=rng.integers(0, 256, (5, 3)),
        attributes={
            "class": np.arange(5, dtype=np.uint8),
            "time": rng.random(5),
            "flag": np.arange(5) > 2,
            "half": np.arange(5, dtype=np.float16),
            "count": np.arange(5) + 2**40,
        },
        crs="EPSG:25832",
        unit="m",
    )


def test_a_cloud_survives_the_round_trip(cloud):
    back = Cloud.from_pyvista(cloud.to_pyvista())
    for name in ("points", "normals", "colors"):
        assert np.array_equal(getattr(back, name), getattr(cloud, name)), name
        assert getattr(back, name).dtype == getattr(cloud, name).dtype, name
    assert back.attributes.keys() == cloud.attributes.keys()
    for name, values in cloud.attributes.items():
        assert np.array_equal(back.attributes[name], values), name
    assert (back.crs, back.unit) == ("EPSG:25832", "m")


def test_pyvista_gets_float64_points_and_its_own_names(cloud):
    data = cloud.to_pyvista()
    assert isinstance(data, pyvista.PolyData)
    assert data.points.dtype == np.float64
    assert data.n_verts == len(cloud)
    assert np.array_equal(data.active_normals, cloud.normals)
    assert np.array_equal(data["RGB"], cloud.colors)
    data.points[:] = 0  # a copy
    assert cloud.points.min() >= 0 < cloud.points[:, 1].min()


def test_a_plain_cloud_has_no_fields():
    back = Cloud.from_pyvista(Cloud([[1.0, 2.0, 3.0]]).to_pyvista())
    assert (back.normals, back.colors, dict(back.attributes), back.crs, back.unit) == (None, None, {}, None, None)


@pytest.mark.parametrize("name", ["RGBA", "colors", "anything"])
def test_colours_of_others_are_found(name):
    data = pyvista.PolyData(np.eye(3))
    data.point_data.set_scalars(np.array([[0, 1, 2, 255]] * 3, np.uint8), name)
    assert Cloud.from_pyvista(data).colors.tolist() == [[0, 1, 2]] * 3


def test_colours_from_0_to_1_become_bytes():
    data = pyvista.PolyData(np.eye(3))
    data["RGB"] = np.array([[0.0, 0.2, 1.0]] * 3)
    assert Cloud.from_pyvista(data).colors.tolist() == [[0, 51, 255]] * 3


def test_any_data_set_with_points_becomes_a_cloud():
    assert len(Cloud.from_pyvista(pyvista.ImageData(dimensions=(2, 3, 4)))) == 24
    with check_error():
        Cloud.from_pyvista(pyvista.PolyData())
    with check_error():
        Cloud.from_pyvista([[0, 0, 0]])


@pytest.mark.parametrize("name", ["Normals", "RGB"])
def test_names_of_fields_are_refused_for_attributes(name):
    with check_error():
        Cloud([[0, 0, 0]], attributes={name: [1]}).to_pyvista()


def test_a_mesh_survives_the_round_trip():
    vertices = [[500_000.001, 0, 0], [500_001, 0, 0], [500_000, 1, 0], [500_000, 0, 1]]
    mesh = Mesh(vertices, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], crs="EPSG:25832", unit="m")
    back = Mesh.from_pyvista(mesh.to_pyvista())
    assert np.array_equal(back.vertices, mesh.vertices)
    assert np.array_equal(back.faces, mesh.faces)
    assert (back.crs, back.unit) == ("EPSG:25832", "m")


def test_polygons_become_triangles():
    cube = Mesh.from_pyvista(pyvista.Cube())  # six squares
    assert (len(cube), cube.area, cube.is_closed) == (12, 6.0, True)


@pytest.mark.parametrize("data", [lambda: pyvista.PolyData(np.eye(3)), lambda: pyvista.ImageData(), lambda: 3])
def test_what_has_no_faces_is_no_mesh(data):
    with check_error():
        Mesh.from_pyvista(data())


def test_a_missing_pyvista_names_the_extra(monkeypatch, tmp_path):
    break_library(monkeypatch, tmp_path, "pyvista", None)
    with check_error(MissingExtra):
        Cloud([[0, 0, 0]]).to_pyvista()
    with check_error(MissingExtra):
        Mesh(np.eye(3), [[0, 1, 2]]).to_pyvista()
