"""Grids of heights as surfaces: ESRI ASCII grids and GeoTIFF."""

import numpy as np
import pytest
from children_here import libraries_read_here
from height_grid_files import CENTERS, HEIGHTS, asc, write_tif
from optional import import_or_skip
from refusals import refusal
from wording import check_error, check_text

from pcbench import read_cloud, read_mesh
from pcbench.errors import InputError
from pcbench.geometry.mesh import MeshIndex
from pcbench.io.source import Source


@pytest.fixture
def tifffile():
    """Let tifffile read files in this process; other tests use the child process."""
    with libraries_read_here():
        yield import_or_skip("tifffile")


@pytest.fixture
def grid(tmp_path):
    (tmp_path / "a.asc").write_text(asc())
    return tmp_path / "a.asc"


def check_grid(path):
    """Check the cells of a file, and its surface: 6 squares less the parts that the missing cell takes."""
    cloud = read_cloud(path, on_warning=lambda _: None)
    np.testing.assert_array_equal(cloud.points, CENTERS)
    notes = []
    mesh = read_mesh(path, on_warning=notes.append)
    np.testing.assert_array_equal(mesh.vertices, CENTERS)
    assert len(mesh) == 2 * 6 - 4  # four squares have three cells with data, one triangle instead of two
    # Of a plane with slopes 1 and 10, the area is sqrt(1 + 1 + 100) times that of its plan.
    np.testing.assert_allclose(mesh.area, np.sqrt(102) * (6 * 6 - 4 * 3), rtol=1e-12)
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()
    return mesh, notes


def test_ascii_grids_are_surfaces(grid):
    mesh, notes = check_grid(grid)
    check_text("\n".join(notes))
    source = Source.open(grid)
    assert (source.kind, source.is_mesh_only) == ("mesh", False)
    # Exact between the centres, where a cloud of them has distances.
    inside = np.array([[102.3, 209.1, 102.3 + 2091], [103.9, 210.0, 103.9 + 2100]])
    np.testing.assert_allclose(MeshIndex(mesh).query(inside).distances, 0, atol=1e-9)


def test_tables_with_the_same_extension_are_clouds(tmp_path):
    (tmp_path / "a.asc").write_text("1 2 3\n4 5 6\n")
    assert Source.open(tmp_path / "a.asc").kind == "cloud"
    with check_error():
        read_mesh(tmp_path / "a.asc")


def test_grids_without_a_surface(tmp_path):
    header = "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n"
    for values in ("1 -9999 -9999 4", "-9999 -9999 -9999 -9999"):
        (tmp_path / "a.asc").write_text(f"{header}{values}\n")
        with check_error():
            read_mesh(tmp_path / "a.asc")


VARIANTS = {
    "float32": {"heights": HEIGHTS.astype("f4")},
    "whole numbers": {"heights": HEIGHTS * 2, "more": [(42112, "s", 0, '<Item role="scale">0.5</Item>', True)]},
    "points": {"raster_type": 2},
    "tiles": {"tile": (16, 16), "compression": "deflate"},
    "BigTIFF": {"bigtiff": True},
    "big-endian": {"byteorder": ">"},
    "matrix": {
        "place": [(34264, "d", 16, (2.0, 0, 0, 100.0, 0, -3.0, 0, 212.0, 0, 0, 0, 0, 0, 0, 0, 1.0), True)],
    },
    "south up": {
        "heights": HEIGHTS[::-1],
        "place": [(34264, "d", 16, (2.0, 0, 0, 100.0, 0, 3.0, 0, 203.0, 0, 0, 0, 0, 0, 0, 0, 1.0), True)],
    },
}
VARIANTS["whole numbers"]["heights"][1, 2] = -9999


@pytest.mark.usefixtures("tifffile")
@pytest.mark.parametrize("name", VARIANTS)
def test_variants_of_geotiff(tmp_path, name):
    mesh, _ = check_grid(write_tif(tmp_path / "a.tif", **VARIANTS[name]))
    if mesh.crs is not None and mesh.crs.startswith("EPSG"):  # with pyproj
        assert (mesh.crs, mesh.unit) == ("EPSG:32632", "m")


def test_heights_in_another_unit(tmp_path):
    import_or_skip("pyproj")
    notes = []
    mesh = read_mesh(write_tif(tmp_path / "a.tif", unit="US survey foot"), on_warning=notes.append)
    assert mesh.unit is None
    check_text("\n".join(notes))


def test_refused_tiffs(tmp_path, tifffile):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, HEIGHTS)
    refusal(path)
    tifffile.imwrite(path, np.zeros((9, 9, 3), np.uint8), photometric="rgb")
    refusal(path)
    turned = [(34264, "d", 16, (2.0, 1.0, 0, 100.0, 1.0, -3.0, 0, 212.0, 0, 0, 0, 0, 0, 0, 0, 1.0), True)]
    refusal(write_tif(path, place=turned))
    whole = write_tif(path).read_bytes()
    for data in (whole[:20], whole[:-30], whole[:4] + b"\xff" * 40, b"ply\n" + bytes(40)):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"a\.tif: "):  # the other words are tifffile's
            read_cloud(path)


def test_info_and_convert(grid, run, monkeypatch):
    monkeypatch.chdir(grid.parent)
    code, out, err = run("info", "a.asc")
    assert (code, err.count("left out 1 of 12 cells")) == (0, 1)
    check_text(out)
    code, out, _ = run("convert", "a.asc", "out.xyz")
    assert (code, len(read_cloud("out.xyz"))) == (0, 11)
