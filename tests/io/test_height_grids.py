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


@pytest.mark.parametrize(
    ("stated", "stored"),
    [
        ("nan", "nan"),
        ("NaN", "NAN"),
        ("-3.4028234663852886e+38", "-3.40282e+38"),
        ("-3.40282346638529e+38", "-3.40282346638529e+38"),
        ("-9999.9", "-9999.900390625"),
        ("-1e400", "-inf"),
        ("0", "0"),
    ],
)
def test_values_for_missing_data(tmp_path, stated, stored):
    text = asc().replace("NODATA_value -9999", f"NODATA_value {stated}").replace("-9999.0", stored)
    (tmp_path / "a.asc").write_text(text)
    check_grid(tmp_path / "a.asc")


def test_a_coordinate_system_beside_a_grid(grid):
    import_or_skip("pyproj")
    wkt = (
        'PROJCS["WGS_1984_UTM_Zone_32N",GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,'
        '298.257223563]],PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
        'PARAMETER["False_Easting",500000.0],PARAMETER["False_Northing",0.0],PARAMETER["Central_Meridian",9.0],'
        'PARAMETER["Scale_Factor",0.9996],PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]'
    )
    grid.with_suffix(".prj").write_text(wkt)
    mesh, notes = check_grid(grid)
    assert "UTM" in mesh.crs or mesh.crs == "EPSG:32632"
    assert (mesh.unit, len(notes)) == ("m", 1)
    grid.with_suffix(".prj").write_text("Projection UTM\nZone 32\n")
    mesh, notes = check_grid(grid)
    assert mesh.crs is None
    check_text("\n".join(notes))


def test_decimal_commas(tmp_path):
    (tmp_path / "a.asc").write_text(asc().replace(".", ","))
    _, notes = check_grid(tmp_path / "a.asc")
    assert notes[0] == f"{tmp_path / 'a.asc'}: commas are read as decimal points"


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
