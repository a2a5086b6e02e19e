"""Write features as a GeoPackage (OGC 12-128r17, version 1.3): an SQLite database that every GIS reads and edits."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.crs import system_definition
from pcbench.io.vector import FeatureGeometry, Value, VectorLayer
from pcbench.scratch import atomic_write

_APPLICATION, _VERSION = 0x47504B47, 10300  # the letters GPKG, and version 1.3.0
_LAST_CHANGE = "1970-01-01T00:00:00.000Z"  # fixed, so that equal layers are equal files
_WKB_KINDS = {"Point": 1, "LineString": 2, "Polygon": 3, "MultiPolygon": 6}
_WKB_HEIGHTS = 1000  # added to the kind of a shape with z
_ENVELOPES = {2: 1, 3: 2}  # code of a box of x and y, and of x, y and z
_INTEGER_LIMIT = 1 << 63
_UNDEFINED_CARTESIAN = -1
_FIRST_OWN_ID = 100_000  # of systems without a code of EPSG
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""
_STANDARD_SYSTEMS = (
    (
        "Undefined Cartesian SRS",
        _UNDEFINED_CARTESIAN,
        "NONE",
        -1,
        "undefined",
        "undefined Cartesian coordinate reference system",
    ),
    ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "undefined geographic coordinate reference system"),
    (
        "WGS 84 geodetic",
        4326,
        "EPSG",
        4326,
        'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
        'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
        'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]',
        "longitude/latitude coordinates in decimal degrees on the WGS 84 spheroid",
    ),
)


def write_geopackage(path: Path, layers: Sequence[VectorLayer]) -> None:
    """Write layers as tables of a GeoPackage, with their own coordinates and systems.

    Systems without an EPSG code are written as WKT; a layer without a known system has none. Columns of whole numbers,
    numbers and yes-or-no values have these types, all others are text. The date of the last change is a fixed one, so
    that equal layers make equal files.

    Args:
        path: output file.
        layers: the layers, at least one, with different names.

    Raises:
        InputError: a layer's name is empty, reserved, or that of another layer.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    names = [layer.name.lower() for layer in layers]
    for name in names:
        if not name or name.startswith(("gpkg_", "sqlite_", "rtree_")) or names.count(name) > 1:
            raise InputError(f"{path}: expected different names of layers that are not reserved, got {name!r}")
    with closing(sqlite3.connect(":memory:")) as database:
        database.executescript(f"PRAGMA application_id = {_APPLICATION}; PRAGMA user_version = {_VERSION}; {_TABLES}")
        database.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", _STANDARD_SYSTEMS)
        systems = {crs: _system_id(database, crs) for crs in dict.fromkeys(layer.crs for layer in layers)}
        for layer in layers:
            _add_layer(database, layer, systems[layer.crs])
        database.commit()
        content = database.serialize()
    with atomic_write(path) as file:
        file.write(content)


def _system_id(database: sqlite3.Connection, crs: str | None) -> int:
    """Return the number of a coordinate system in the database, to which it is added: the EPSG code, or an own one."""
    system = None if crs is None else system_definition(crs)
    if system is None:
        return _UNDEFINED_CARTESIAN
    (largest,) = database.execute("SELECT max(srs_id) FROM gpkg_spatial_ref_sys").fetchone()
    own = max(largest + 1, _FIRST_OWN_ID)
    authority, code = system.authority or ("NONE", own)
    number = code if authority == "EPSG" else own
    row = (system.name, number, authority, code, system.wkt, None)
    database.execute("INSERT OR IGNORE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", row)
    return number


def _add_layer(database: sqlite3.Connection, layer: VectorLayer, system: int) -> None:
    shapes = [feature.geometry for feature in layer.features]
    kinds = {shape.kind for shape in shapes}
    kind = kinds.pop().upper() if len(kinds) == 1 else "GEOMETRY"
    rows = layer.rows()
    columns = list(zip(*rows, strict=True)) if rows else []
    types = [_column_type(column) for column in columns]
    fields = [f"{_quoted(name)} {kind}" for name, kind in zip(_column_names(layer.columns), types, strict=True)]
    table = _quoted(layer.name)
    listed = ", ".join(["fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL", f"geom {kind}", *fields])
    database.execute(f"CREATE TABLE {table} ({listed})")
    boxes = [_corners(shape.positions[:, :2]) for shape in shapes]
    low, high = (np.array(corners) for corners in zip(*boxes, strict=True)) if boxes else (None, None)
    box = (None,) * 4 if low is None or high is None else (*low.min(axis=0).tolist(), *high.max(axis=0).tolist())
    with_heights = {shape.has_heights for shape in shapes}
    z = 2 if len(with_heights) == 2 else int(True in with_heights)
    content = (layer.name, "features", layer.name, "", _LAST_CHANGE, *box, system)
    database.execute("INSERT INTO gpkg_contents VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", content)
    database.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, ?, ?, ?, ?, ?)", (layer.name, "geom", kind, system, z, 0)
    )
    places = ", ".join("?" * (2 + len(types)))
    values = (
        (number, _blob(shape, system), *map(_stored, row, types))
        for number, (shape, row) in enumerate(zip(shapes, rows, strict=True), 1)
    )
    database.executemany(f"INSERT INTO {table} VALUES ({places})", values)


def _column_names(names: Sequence[str]) -> list[str]:
    """Return names that differ from each other and from those of the standard columns, whatever their case."""
    used = {"fid", "geom"}
    unique = []
    for name in names:
        number, free = 2, name or "unnamed"
        while free.lower() in used:
            free, number = f"{name}_{number}", number + 1
        used.add(free.lower())
        unique.append(free)
    return unique


def _column_type(values: Iterable[Value]) -> str:
    present = [value for value in values if value is not None]
    if all(isinstance(value, bool) for value in present):
        return "BOOLEAN" if present else "TEXT"
    if any(isinstance(value, bool | str) for value in present):
        return "TEXT"
    is_whole = all(isinstance(value, int) and abs(value) < _INTEGER_LIMIT for value in present)
    return "INTEGER" if is_whole else "DOUBLE"


def _stored(value: Value, kind: str) -> Value:
    """Return a value as its column stores it."""
    if value is None:
        return None
    return str(value) if kind == "TEXT" else float(value) if kind == "DOUBLE" else int(value)


def _quoted(name: str) -> str:
    """Return a name for SQL."""
    return '"' + name.replace('"', '""') + '"'


def _blob(shape: FeatureGeometry, system: int) -> bytes:
    """Return a shape as GeoPackageBinary (section 2.1.3): a header with its box, and its WKB (ISO 13249-3)."""
    low, high = _corners(shape.positions)
    box = np.stack([low, high], axis=1)  # the ranges of x, y and z
    flags = 1 | _ENVELOPES[len(box)] << 1  # little-endian
    return struct.pack("<2sBBi", b"GP", 0, flags, system) + box.astype("<f8").tobytes() + _wkb(shape)


def _wkb(shape: FeatureGeometry) -> bytes:
    head = struct.pack("<BI", 1, _WKB_KINDS[shape.kind] + shape.has_heights * _WKB_HEIGHTS)

    def positions(ring: FloatArray) -> bytes:
        return struct.pack("<I", len(ring)) + ring.astype("<f8").tobytes()

    match shape.kind:
        case "Point":
            return head + shape.positions.astype("<f8").tobytes()
        case "LineString":
            return head + positions(shape.positions)
        case "Polygon":
            (rings,) = shape.parts
            return head + struct.pack("<I", len(rings)) + b"".join(map(positions, rings))
        case "MultiPolygon":
            polygons = [_wkb(FeatureGeometry("Polygon", (rings,))) for rings in shape.parts]
            return head + struct.pack("<I", len(polygons)) + b"".join(polygons)


def _corners(positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and the highest corner of positions (N, 2 or 3)."""
    return positions.min(axis=0), positions.max(axis=0)
