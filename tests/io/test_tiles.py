"""Clouds in many files: folders, patterns, .vpc indexes and Entwine Point Tiles, in memory and in pieces."""

import json
import os
import struct
import time

import ept_bytes
import mesh_bytes
import numpy as np
import ply_bytes
import pytest
from cloud_pieces import check_pieces
from las_bytes import UTM, extra, extras, geo_keys, las, wkt
from las_tiles import write_tiles
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud, write_cloud
from pcbench.io.contents import digest
from pcbench.io.outputs import check_output
from pcbench.io.pieces import open_cloud, read_piece
from pcbench.io.source import Source


def write_vpc(path, hrefs, assets="data"):
    features = [{"type": "Feature", "assets": {assets: {"href": href, "roles": ["data"]}}} for href in hrefs]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def ply_tile(count):
    return ply_bytes.ply("binary_little_endian", ("vertex", ply_bytes.XYZ, ply_bytes.points(count)))


@pytest.fixture
def tiles(tmp_path):
    """Two LAS tiles, an empty one and a PLY tile, with other files beside them."""
    folder = tmp_path / "tiles"
    folder.mkdir()
    (folder / "tile_10.las").write_bytes(las(1, indices=range(30)))
    (folder / "tile_2.LAS").write_bytes(las(1, indices=range(30, 50)))
    (folder / "tile_3.las").write_bytes(las(1, 0))
    (folder / "tile_11.ply").write_bytes(ply_tile(12))
    (folder / "index.shp").write_bytes(b"shapes")
    (folder / "._tile_2.las").write_bytes(b"resource fork")
    (folder / "sub").mkdir()
    return folder


def names(disk):
    return [file.path.name for file in disk.files]


def test_folder_in_natural_order(tiles):
    disk, cloud = check_pieces(tiles, 7)
    assert names(disk) == ["tile_2.LAS", "tile_3.las", "tile_10.las", "tile_11.ply"]
    assert [file.count for file in disk.files] == [20, 0, 30, 12]
    first = read_cloud(tiles / "tile_2.LAS").points
    np.testing.assert_array_equal(cloud.points[:20], first)
    assert cloud.attributes == {}  # a PLY tile without attributes


def test_what_only_some_files_have_is_left_out(tiles):
    (tiles / "tile_11.ply").unlink()
    described = extras(extra(b"nx", 9), extra(b"ny", 9), extra(b"nz", 9), extra(b"height", 9))
    (tiles / "tile_4.las").write_bytes(las(3, 5, vlrs=[described], tail=lambda i: bytes(16)))
    lines = []
    cloud = read_cloud(tiles, on_warning=lines.append)
    for line in lines:
        check_text(line, masked=False)
    assert cloud.normals is cloud.colors is None
    assert "intensity" in cloud.attributes and "height" not in cloud.attributes
    check_pieces(tiles, 7)


def test_equal_warnings_of_many_files_are_one_line(tiles):
    described = extras(extra(b"a\nb", 9))
    for number in range(20, 26):
        (tiles / f"tile_{number}.las").write_bytes(las(3, 5, vlrs=[described], tail=lambda i: bytes(4)))
    lines = []
    read_cloud(tiles / "tile_2?.las", on_warning=lines.append)
    assert len(lines) == 1
    check_text(lines[0], masked=False)
    check_pieces(tiles / "tile_2?.las", 2)


def test_tables_beside_clouds_are_left_out(tiles):
    (tiles / "readme.txt").write_text("three tiles")
    (tiles / "areas.csv").write_text("name,area\na,7\n")
    disk, _ = check_pieces(tiles)
    check_text(disk.warnings[0], masked=False)
    for file in tiles.iterdir():
        if file.suffix.lower() in (".las", ".ply", ".csv"):
            file.unlink()
    (tiles / "readme.txt").write_text("1 2 3\n")
    assert len(check_pieces(tiles)[1]) == 1


def test_meshes_beside_clouds_are_left_out(tiles):
    (tiles / "mesh.ply").write_bytes(mesh_bytes.ply_mesh())
    disk, _ = check_pieces(tiles)
    check_text(disk.warnings[0], masked=False)
    for file in [file for file in tiles.iterdir() if file.is_file() and file.name != "mesh.ply"]:
        file.unlink()
    assert len(check_pieces(tiles)[1]) == len(mesh_bytes.VERTICES)


def test_buffers_of_gltf_are_no_clouds(tmp_path):
    positions = np.arange(12, dtype="<f4")  # also a scan of KITTI
    (tmp_path / "a.bin").write_bytes(positions.tobytes())
    part = {"attributes": {"POSITION": 0}, "mode": 0}
    accessor = {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}
    document = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [part]}],
        "accessors": [accessor],
        "bufferViews": [{"buffer": 0, "byteLength": 48}],
        "buffers": [{"uri": "a.bin", "byteLength": 48}],
    }
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    assert read_cloud(tmp_path).points.tolist() == positions.reshape(4, 3).tolist()


def test_copies_in_other_formats_are_named(tmp_path):
    for name in ("a.xyz", "b.xyz", "b.copc.npy", "b.npy"):
        write_cloud(tmp_path / name, np.eye(3))
    for path in (tmp_path, tmp_path / "*"):
        lines = []
        assert len(read_cloud(path, on_warning=lines.append)) == 12
        check_text(*lines, masked=False)


def test_pattern(tiles):
    disk, _ = check_pieces(tiles / "tile_*.las", 7)
    assert names(disk) == ["tile_3.las", "tile_10.las"]
    (tiles / "sub/tile_1.las").write_bytes(las(1, indices=range(90, 97)))
    assert names(check_pieces(tiles.parent / "**/*_1*.las")[0]) == ["tile_1.las", "tile_10.las"]
    with check_error():
        read_cloud(tiles / "*.laz")


def test_name_with_the_signs_of_a_pattern(tmp_path):
    (tmp_path / "a[1].las").write_bytes(las(1, 5))
    assert len(check_pieces(tmp_path / "a[1].las")[0].files) == 1


def test_vpc(tiles):
    index = write_vpc(tiles.parent / "area.vpc", ["tiles/tile_10.las", "./tiles/tile_2.LAS"])
    assert names(check_pieces(index, 7)[0]) == ["tile_2.LAS", "tile_10.las"]
    features = json.loads(index.read_text())
    features["features"][0]["assets"]["overview"] = {"href": "./none.copc.laz", "roles": ["overview"]}
    features["features"][1]["assets"]["data"]["href"] = (tiles / "tile_11.ply").as_uri()
    index.write_text(json.dumps(features))
    assert names(check_pieces(index, 7)[0]) == ["tile_10.las", "tile_11.ply"]


@pytest.mark.parametrize("text", ["", "[1]", "{}", '{"features": [{"assets": {"data": {}}}]}', '{"features": []}'])
def test_damaged_vpc(tmp_path, text):
    (tmp_path / "a.vpc").write_text(text)
    with check_error():
        read_cloud(tmp_path / "a.vpc")
    with check_error():
        open_cloud(tmp_path / "a.vpc")


def test_vpc_that_names_a_file_twice(tiles):
    index = write_vpc(tiles.parent / "area.vpc", ["tiles/tile_10.las", "./tiles/tile_10.las"])
    for read in (read_cloud, open_cloud):
        with check_error():
            read(index)


@pytest.mark.parametrize("skip_bad", [False, True])
def test_a_path_that_does_not_exist(tmp_path, skip_bad):
    with check_error():
        open_cloud(tmp_path / "tils", skip_bad=skip_bad)


def test_vpc_of_remote_files(tmp_path):
    with check_error():
        read_cloud(write_vpc(tmp_path / "a.vpc", ["https://example.org/a.laz"]))


def test_missing_tile(tiles):
    index = write_vpc(tiles.parent / "area.vpc", ["tiles/tile_2.LAS", "tiles/tile_7.las"])
    for read in (read_cloud, open_cloud):
        with check_error():
            read(index)
    disk = open_cloud(index, skip_bad=True)
    assert [(file.path.name, file.count) for file in disk.left_out] == [("tile_7.las", None)]
    check_text(disk.left_out[0].reason)
    assert disk.count == 20


def test_folder_without_clouds(tmp_path):
    (tmp_path / "a.pdf").touch()
    for read in (read_cloud, open_cloud):
        with check_error():
            read(tmp_path)


def test_folder_of_a_colmap_model_stays_one(tmp_path):
    (tmp_path / "points3D.txt").write_text("1 0.5 1.5 2.5 9 8 7 0.1 1 2\n")
    (tmp_path / "fused.ply").write_bytes(ply_tile(12))
    assert len(check_pieces(tmp_path)[1]) == 1
    assert Source.open(tmp_path).tiles is None


@pytest.mark.long
def test_round_trip_through_tiles(tmp_path):
    import_or_skip("lazrs")
    points = np.random.default_rng(0).uniform((0, 0, 0), (50, 30, 5), (3000, 3))
    folder = write_tiles(tmp_path / "tiles", Cloud(points), 10)
    disk, cloud = check_pieces(folder, 100)
    assert len(disk.files) == 15 and len(cloud) == 3000
    assert abs(np.sort(cloud.points, axis=0) - np.sort(points, axis=0)).max() < 1e-4


# ---- filters, coordinate systems ----


def test_tiles_without_points_of_a_class(tiles):
    (tiles / "tile_11.ply").unlink()
    (tiles / "tile_1.las").write_bytes(las(1, indices=range(0, 10, 2)))  # class 6 only
    disk, cloud = check_pieces(tiles, 7, classes=(2,))
    assert len(cloud) == 25 and disk.count == 55
    with check_error():
        read_cloud(tiles, classes=(9,), returns="first")


def test_filters_need_classes_in_all_files(tiles):
    assert not Source.open(tiles).has_classes
    assert Source.open(tiles / "*.las").has_classes and Source.open(tiles / "tile_10.las").has_classes
    for read in (read_cloud, open_cloud):
        with check_error():
            read(tiles, classes=(2,))
    with pytest.raises(ValueError, match="to filter by classes"):
        open_cloud(tiles, classes=(2,), skip_bad=True)


def test_different_coordinate_systems(tiles):
    (tiles / "tile_2.LAS").write_bytes(las(1, 5, vlrs=[wkt(UTM)]))
    disk, _ = check_pieces(tiles)
    assert disk.crs == "EPSG:32617" and disk.unit == "m"
    for line in disk.warnings:
        check_text(line, masked=False)
    (tiles / "tile_10.las").write_bytes(las(1, 5, vlrs=[geo_keys(model=1, projected=32618)]))
    for read in (read_cloud, open_cloud):
        with check_error():
            read(tiles)
    with pytest.raises(ValueError, match="one coordinate reference system"):
        open_cloud(tiles, skip_bad=True)


def test_different_units(tiles):
    def state_units(*units):
        for number, unit in enumerate(units, 12):
            vertices = ("vertex", ply_bytes.XYZ, ply_bytes.points(3))
            data = ply_bytes.ply("ascii", vertices, comments=[f"comment unit {unit}"])
            (tiles / f"tile_{number}.ply").write_bytes(data)

    state_units("ft", "feet")  # two names of one unit
    assert open_cloud(tiles).unit == "ft"
    state_units("m", "ft")
    for read in (read_cloud, open_cloud):
        with check_error():
            read(tiles)


# ---- Entwine Point Tiles ----


@pytest.mark.parametrize("data_type", ["laszip", "binary"])
def test_ept(tmp_path, data_type):
    if data_type == "laszip":
        import_or_skip("lazrs")
    folder = ept_bytes.write(tmp_path / "ept", data_type=data_type)
    (tmp_path / "a.las").write_bytes(las(6, indices=ept_bytes.point_order()))
    expected = read_cloud(tmp_path / "a.las")
    for path in (folder, folder / "ept.json"):
        disk, cloud = check_pieces(path, 25)
        assert cloud.points.tobytes() == expected.points.tobytes()
        assert cloud.attributes.keys() == expected.attributes.keys()
        for name, values in expected.attributes.items():
            np.testing.assert_array_equal(cloud.attributes[name], values)
        assert (cloud.crs, cloud.unit) == ("EPSG:32617", "m")
        assert [piece.count for piece in disk.pieces] == [20, 20, 20]
    check_pieces(folder, 1, classes=(2,), returns="last")
    assert len(read_cloud(folder, classes=(6,))) == 30
    with check_error():
        read_cloud(folder, classes=(9,))


def change_json(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def dimension(size, name="X"):
    return {"name": name, "type": "float", "size": size}


EPT_DAMAGE = {
    "zstandard": lambda folder: change_json(folder / "ept.json", dataType="zstandard"),
    "no schema": lambda folder: change_json(folder / "ept.json", schema=None),
    "no coordinates": lambda folder: change_json(
        folder / "ept.json", schema=[{"name": "X", "type": "float", "size": 8}]
    ),
    "wrong size": lambda folder: change_json(folder / "ept.json", schema=[{"name": "X", "type": "float", "size": 3}]),
    "wrong type": lambda folder: change_json(folder / "ept.json", schema=[{"name": "X", "type": "complex", "size": 8}]),
    "wrong count": lambda folder: change_json(folder / "ept.json", points=61),
    "count as text": lambda folder: change_json(folder / "ept.json", points="many"),
    "no hierarchy": lambda folder: (folder / "ept-hierarchy/0-0-0-0.json").unlink(),
    "no page": lambda folder: (folder / "ept-hierarchy/1-1-0-0.json").unlink(),
    "loop": lambda folder: change_json(folder / "ept-hierarchy/1-1-0-0.json", **{"0-0-0-0": -1}),
    "key outside": lambda folder: change_json(folder / "ept-hierarchy/1-1-0-0.json", **{"2-4-0-0": 1}),
    "path": lambda folder: change_json(folder / "ept-hierarchy/1-1-0-0.json", **{"../../a": 1}),
    "negative": lambda folder: change_json(folder / "ept-hierarchy/1-1-0-0.json", **{"2-2-0-0": -5}),
    "no node": lambda folder: (folder / "ept-data/1-0-0-0.bin").unlink(),
    "cut": lambda folder: os.truncate(folder / "ept-data/1-0-0-0.bin", 100),
}


@pytest.mark.parametrize("damage", EPT_DAMAGE)
def test_damaged_ept(tmp_path, damage):
    folder = ept_bytes.write(tmp_path / "ept", data_type="binary")
    EPT_DAMAGE[damage](folder)
    for read in (read_cloud, open_cloud):
        with check_error():
            read(folder)


def test_ept_may_say_floating(tmp_path):
    """PDAL's name of the type float."""
    folder = ept_bytes.write(tmp_path / "ept", data_type="binary")
    expected = read_cloud(folder)
    text = (folder / "ept.json").read_text()
    (folder / "ept.json").write_text(text.replace('"float"', '"floating"'))
    assert '"floating"' in (folder / "ept.json").read_text()
    np.testing.assert_array_equal(read_cloud(folder).attributes["gps_time"], expected.attributes["gps_time"])


def test_damaged_node_of_ept_is_named(tmp_path):
    import_or_skip("lazrs")
    folder = ept_bytes.write(tmp_path / "ept")
    (folder / "ept-data/1-0-0-0.laz").write_bytes(las(6, 7, compress="chunks"))
    with check_error():
        read_cloud(folder)


def test_points_outside_the_bounds_of_a_node_are_a_warning_with_its_name(tmp_path):
    import_or_skip("lazrs")
    folder = ept_bytes.write(tmp_path / "ept")
    node = folder / "ept-data/1-0-0-0.laz"
    points = read_cloud(node).points
    (x_low, y_low, z_low), (x_high, y_high, z_high) = points.min(axis=0), points.max(axis=0)
    for beyond in (0.0, 3.0):
        data, warnings = bytearray(node.read_bytes()), []
        struct.pack_into("<6d", data, 179, x_high - beyond, x_low, y_high, y_low, z_high, z_low)
        node.write_bytes(data)
        read_cloud(folder, on_warning=warnings.append)
        assert [line.partition("ept.json: ")[2] for line in warnings] == [
            f"1-0-0-0.laz: points lie up to {beyond:g} units outside the header's bounds in x: the header was not"
            " updated, or points are damaged"
        ] * (beyond > 0)


def test_damaged_bytes_of_a_node_are_reported_with_its_name(tmp_path):
    import_or_skip("lazrs")
    folder = ept_bytes.write(tmp_path / "ept", 600)
    node = folder / "ept-data/1-0-0-0.laz"
    data = bytearray(node.read_bytes())
    sizes = int.from_bytes(data[96:100], "little") + 38  # of the layers, after the first point
    data[sizes : sizes + 40] = b"\xff" * 40
    node.write_bytes(data)
    disk = open_cloud(folder)
    with check_error():
        read_piece(disk, disk.pieces[0])


def test_many_nodes_are_decompressed_in_batches(tmp_path, monkeypatch):
    import_or_skip("lazrs")
    folder = ept_bytes.write(tmp_path / "ept")
    expected = read_cloud(folder)
    monkeypatch.setattr("pcbench.io.laz._MAX_RUNS", 4)
    assert read_cloud(folder).points.tobytes() == expected.points.tobytes()


# ---- outputs and speed ----


def test_digest_covers_all_files(tiles):
    index = write_vpc(tiles.parent / "area.vpc", ["tiles/tile_10.las"])
    ept = ept_bytes.write(tiles.parent / "ept", data_type="binary")
    paths = (tiles, tiles / "*.las", index, ept, ept / "ept.json")
    before = [digest(path) for path in paths]
    assert len(set(before)) == 4  # the last two are the same
    (tiles / "tile_10.las").write_bytes(las(1, 31))
    (ept / "ept-data/0-0-0-0.bin").write_bytes(b"")
    assert not set(before) & {digest(path) for path in paths}


def test_a_tile_is_not_replaced_by_a_result(tiles):
    index = write_vpc(tiles.parent / "area.vpc", ["tiles/tile_10.las"])
    for named in (tiles, tiles / "*.las", index):
        with check_error():
            check_output(tiles / "tile_10.las", [named])
    check_output(tiles.parent / "all.las", [tiles, tiles / "*.las", index])


def test_a_thousand_files_are_opened_in_about_a_second(tmp_path):
    import_or_skip("lazrs")
    data = las(7, 300, vlrs=[wkt(UTM)], compress="chunks")
    for number in range(1000):
        (tmp_path / f"{number}.laz").write_bytes(data)
    start = time.process_time()
    assert len(open_cloud(tmp_path).pieces) == 1000
    assert time.process_time() - start < 2


def test_write_cloud_of_tiles(tiles, tmp_path):
    write_cloud(tmp_path / "all.ply", tiles / "tile_1*.las")
    assert len(read_cloud(tmp_path / "all.ply")) == 30
