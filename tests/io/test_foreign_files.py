"""Files that other programs wrote: `tests/foreign/make.py` made them and defines what they hold."""

import runpy
from types import SimpleNamespace

import numpy as np
import pytest
from optional import import_or_skip
from repository import TESTS

from pcbench import read_cloud, read_mesh

FOLDER = TESTS / "foreign"
WRITTEN = SimpleNamespace(**runpy.run_path(str(FOLDER / "make.py")))
NEEDED = {".laz": "lazrs", ".e57": "pye57", ".glb": "trimesh"}
LAS = {"intensity", "classification", "return_number", "number_of_returns", "gps_time", "point_source_id"}
MODEL = {"point3D_id", "reprojection_error", "track_length"}

CLOUDS = {  # file: what it holds beside points, and its attributes
    "cloudcompare.asc": ("colors", set()),
    "cloudcompare.ply": ("colors", set()),
    "cloudcompare_ascii.ply": ("colors", set()),
    "laspy_format_3.las": ("colors", LAS),
    "laspy_format_7.laz": ("colors", {*LAS, "amplitude"}),
    "meshlab.obj": ("colors normals", set()),
    "meshlab.ply": ("colors", {"alpha", "quality"}),
    "meshlab.xyz": ("normals", set()),
    "numpy.npy": ("", set()),
    "numpy.npz": ("colors", set()),
    "numpy.txt": ("colors", set()),
    "open3d.pts": ("colors", {"intensity"}),
    "open3d.xyz": ("", set()),
    "open3d_ascii.pcd": ("colors normals", set()),
    "open3d_ascii.ply": ("colors normals", set()),
    "open3d_binary.pcd": ("colors normals", set()),
    "open3d_binary.ply": ("colors normals", set()),
    "open3d_compressed.pcd": ("colors normals", set()),
    "pandas.csv": ("", {"intensity"}),
    "pandas_index.csv": ("", {"intensity"}),
    "plyfile_16_bit.ply": ("colors normals", set()),
    "plyfile_ascii.ply": ("colors", {"intensity"}),
    "plyfile_big.ply": ("colors", {"intensity"}),
    "plyfile_little.ply": ("colors", {"intensity"}),
    "pycolmap_bin": ("colors", MODEL),
    "pycolmap_txt": ("colors", MODEL),
    "pye57.e57": ("colors", {"intensity"}),
    "pypcd4_ascii.pcd": ("", {"intensity"}),
    "pypcd4_binary.pcd": ("colors", set()),
    "pypcd4_binary_compressed.pcd": ("colors", set()),
    "trimesh.ply": ("colors", {"alpha"}),
    "trimesh.xyz": ("colors", {"alpha"}),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_of_other_programs(name):
    file, (arrays, attributes) = FOLDER / name, CLOUDS[name]
    if file.suffix in NEEDED:
        import_or_skip(NEEDED[file.suffix])
    cloud = read_cloud(file, on_warning=lambda _: None)
    # COLMAP models and octrees may have another order.
    ours, theirs = np.lexsort(cloud.points.T), np.lexsort(WRITTEN.POINTS.T)
    np.testing.assert_array_equal(cloud.points[ours], WRITTEN.POINTS[theirs])
    assert (cloud.colors is not None, cloud.normals is not None) == ("colors" in arrays, "normals" in arrays)
    if cloud.colors is not None:
        np.testing.assert_array_equal(cloud.colors[ours], WRITTEN.COLORS[theirs])
    if cloud.normals is not None:
        np.testing.assert_array_equal(cloud.normals[ours], WRITTEN.NORMALS[theirs])
    assert attributes <= set(cloud.attributes)
    if "intensity" in attributes:
        values = cloud.attributes["intensity"][ours]
        assert (values == 0).all() if name == "open3d.pts" else (values == WRITTEN.INTENSITY[theirs]).all()
    if "classification" in attributes:
        np.testing.assert_array_equal(cloud.attributes["classification"][ours], WRITTEN.CLASSES[theirs])


@pytest.mark.parametrize("name", sorted(file.name for file in (FOLDER / "surfaces").iterdir()))
def test_meshes_of_other_programs(name):
    file = FOLDER / "surfaces" / name
    if file.suffix in NEEDED:
        import_or_skip(NEEDED[file.suffix])
    mesh = read_mesh(file)
    assert (mesh.area, mesh.is_closed) == (pytest.approx(22, rel=1e-12), True)


def test_each_file_is_tested():
    kept = {file.name for file in FOLDER.iterdir()} - {"make.py", "surfaces", "splats", "__pycache__"}
    assert kept == set(CLOUDS)
