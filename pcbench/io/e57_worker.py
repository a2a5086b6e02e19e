"""Read an E57 file with pye57 in a child process: `e57_worker.py FILE FOLDER [SCAN]`.

SCAN is the index of the scan to read, or `headers` to describe all scans without reading points; by default all are
read.

libE57Format, which pye57 wraps, may crash or hang on damaged files. The parent limits the time and memory of this
process, and reports the file. The script does not import pcbench. It writes to the folder `scans.json` (points, dropped
points, fields and type of colours of each scan) and the columns of scan k as raw float64: `k.points` and `k.FIELD`.
Points are in the file's coordinates: the pose of the scan is applied. Colours of a scan that states their limits are
from 0 to 255 (type "u1"), others are as stored. Exit status: 0, 3 if pye57 does not load, 4 if the disk is full,
or 1 with a reason on standard error.
"""

import json
import os
import sys
from typing import Any

_RECORDS = 1 << 18  # points per read: memory depends on the data present, not on the count that a damaged file states
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_NORMALS = (("nor:normalX", "nor:normalY", "nor:normalZ"), ("normalX", "normalY", "normalZ"), ("nx", "ny", "nz"))
_STATES = ("cartesianInvalidState", "sphericalInvalidState")


def main(source: str, folder: str, wanted: str = "all") -> None:
    """Write all scans of an E57 file, one scan, or only their descriptions to a folder."""
    try:
        from pye57 import libe57
    except (ImportError, OSError):
        sys.exit(3)

    file = libe57.ImageFile(source, "r")  # verifies the checksum of each page
    root = file.root()
    scans = root["data3D"] if root.isDefined("data3D") else []
    described = []
    for number in range(len(scans)):
        if wanted == "headers":
            described.append(_describe(libe57, scans[number]))
        elif wanted in ("all", str(number)):
            described.append(_read(file, libe57, scans[number], os.path.join(folder, str(number))))  # noqa: PTH118
    crs = root["coordinateMetadata"].value() if root.isDefined("coordinateMetadata") else ""
    with open(os.path.join(folder, "scans.json"), "w", encoding="utf-8") as out:  # noqa: PTH118, PTH123
        json.dump({"crs": crs, "scans": described}, out)


def _describe(libe57: Any, scan: Any) -> dict[str, Any]:
    """Return the point count of a scan, including points that are marked as invalid, and its fields."""
    if not scan.isDefined("points"):
        return {"points": 0, "fields": []}
    points = scan["points"]
    names = _names(libe57.StructureNode(points.prototype()))
    has_points = any(set(axes) <= set(names) for axes in (_CARTESIAN, _SPHERICAL))
    return {"points": points.childCount() if has_points else 0, "fields": [name.replace(":", "_") for name in names]}


def _names(prototype: Any) -> list[str]:
    return [prototype.get(k).elementName() for k in range(prototype.childCount())]


def _read(file: Any, libe57: Any, scan: Any, stem: str) -> dict[str, Any]:
    """Write the columns of one scan; return its point count, the number of dropped points, and its fields."""
    import numpy as np

    if not scan.isDefined("points"):
        return {"points": 0, "dropped": 0, "fields": []}
    points = scan["points"]
    prototype = libe57.StructureNode(points.prototype())
    names = _names(prototype)
    axes = next((axes for axes in (_CARTESIAN, _SPHERICAL) if set(axes) <= set(names)), None)
    if axes is None or not points.childCount():  # libE57Format refuses to read a scan without points
        return {"points": 0, "dropped": 0, "fields": []}
    turn, shift = _pose(scan)
    state = _STATES[axes is _SPHERICAL]
    others = [name for name in names if name not in (*_CARTESIAN, *_SPHERICAL, *_STATES)]
    wanted = [*axes, *others, *([state] if state in names else [])]
    columns = {name: np.empty(_RECORDS) for name in wanted}
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        buffers.append(libe57.SourceDestBuffer(file, name, column, _RECORDS, True, True))
    has_colors = set(_COLORS) <= set(names)
    limits = _color_limits(scan) if has_colors else {}
    kept = dropped = 0
    reader = points.reader(buffers)
    outputs = {name: open(f"{stem}.{name.replace(':', '_')}", "wb") for name in ("points", *others)}  # noqa: PTH123, SIM115
    while count := reader.read():
        part = {name: column[:count] for name, column in columns.items()}
        valid = part[state] == 0 if state in part else np.ones(count, bool)
        part = {name: column[valid] for name, column in part.items()}
        xyz = np.stack([part[axis] for axis in axes], axis=1)
        if axes is _SPHERICAL:
            distance, azimuth, elevation = xyz.T
            across = distance * np.cos(elevation)
            xyz = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), distance * np.sin(elevation)], axis=1)
        xyz = xyz @ turn.T + shift
        for normals in _NORMALS:
            if set(normals) <= set(part):
                turned = np.stack([part[axis] for axis in normals], axis=1) @ turn.T
                part |= dict(zip(normals, turned.T, strict=True))
        for name, (low, high) in limits.items():
            part[name] = np.clip(np.rint((part[name] - low) * (255 / (high - low))), 0, 255)
        xyz.tofile(outputs["points"])
        for name in others:
            np.ascontiguousarray(part[name]).tofile(outputs[name])
        kept, dropped = kept + len(xyz), dropped + int(count - valid.sum())
    reader.close()
    for output in outputs.values():
        output.close()
    stated = points.childCount()
    if kept + dropped != stated:
        sys.exit(f"truncated: got {kept + dropped} of {stated} points")
    color_type = "u1" if limits else _color_type(prototype, libe57) if has_colors else None
    fields = [name.replace(":", "_") for name in others]
    return {"points": kept, "dropped": dropped, "fields": fields, "color_type": color_type}


def _pose(scan: Any) -> tuple[Any, Any]:
    """Return the rotation (3, 3) and translation (3,) from a scan to the file's coordinates."""
    import numpy as np

    turn, shift = np.eye(3), np.zeros(3)
    if scan.isDefined("pose"):
        pose = scan["pose"]
        if pose.isDefined("translation"):
            shift = np.array([pose["translation"][axis].value() for axis in "xyz"])
        if pose.isDefined("rotation"):
            q = np.array([pose["rotation"][axis].value() for axis in "wxyz"])
            length = float(np.linalg.norm(q))
            if not abs(length - 1) < 1e-3:
                sys.exit(f"expected the rotation of a scan as a unit quaternion, got one of length {length:.6g}")
            w, x, y, z = q / length
            turn = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
                ]
            )
    return turn, shift


def _color_limits(scan: Any) -> dict[str, tuple[float, float]]:
    """Return the minimum and maximum of each colour, to map to 0 and 255; empty if the scan states none."""
    if not scan.isDefined("colorLimits"):
        return {}
    stated = scan["colorLimits"]
    limits = {}
    for name in _COLORS:
        if not (stated.isDefined(f"{name}Minimum") and stated.isDefined(f"{name}Maximum")):
            return {}
        limits[name] = (float(stated[f"{name}Minimum"].value()), float(stated[f"{name}Maximum"].value()))
    return limits if all(high > low for low, high in limits.values()) else {}


def _color_type(prototype: Any, libe57: Any) -> str:
    """Return the type of colours as stored: "u2" for whole numbers of at most 16 bits, "i8" for others, or "f8"."""
    nodes = [prototype[name] for name in _COLORS]
    if not all(isinstance(node, libe57.IntegerNode) for node in nodes):
        return "f8"
    return "u2" if all(node.minimum() >= 0 and node.maximum() < 1 << 16 for node in nodes) else "i8"


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except OSError:  # from writing outputs: libE57Format raises its own errors
        sys.exit(4)
    except MemoryError:
        sys.exit("it requests more memory than a file of its size can need")
    except Exception as error:
        sys.exit(" ".join((str(error).strip().splitlines() or [type(error).__name__])[0].split()))
