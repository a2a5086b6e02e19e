"""Hand-made Entwine Point Tiles with the points of `las_bytes`. Does not import pcbench."""

import json
import struct

from las_bytes import OFFSETS, SCALES, UTM, integers, las, values

# Nodes in the order of their keys. The hierarchy of the last two is in a separate file.
NODES = ("0-0-0-0", "1-0-0-0", "1-1-0-0", "1-1-1-1", "2-2-0-0", "2-3-1-0")
_PAGE = "1-1-0-0"
_DIMENSIONS = {  # name: type, bytes
    **dict.fromkeys("XYZ", ("signed", 4)),
    **{"Intensity": ("unsigned", 2), "ReturnNumber": ("unsigned", 1), "NumberOfReturns": ("unsigned", 1)},
    **{"Classification": ("unsigned", 1), "PointSourceId": ("unsigned", 2), "GpsTime": ("float", 8)},
}


def write(folder, count=60, data_type="laszip"):
    """Write `count` points as EPT; node k contains every sixth point from point k. Return the folder."""
    for name in ("ept-data", "ept-hierarchy", "ept-sources"):
        (folder / name).mkdir(parents=True)
    counts = {}
    for k, node in enumerate(NODES):
        indices = range(k, count, len(NODES))
        counts[node] = len(indices)
        if data_type == "binary":
            (folder / f"ept-data/{node}.bin").write_bytes(b"".join(map(_record, indices)))
        else:
            (folder / f"ept-data/{node}.laz").write_bytes(las(6, indices=indices, compress="chunks"))
    root = {node: counts[node] for node in NODES[:4]} | {_PAGE: -1, "1-0-1-0": 0}
    (folder / "ept-hierarchy/0-0-0-0.json").write_text(json.dumps(root))
    page = {node: counts[node] for node in (_PAGE, *NODES[4:])}
    (folder / f"ept-hierarchy/{_PAGE}.json").write_text(json.dumps(page))
    schema = [{"name": name, "type": kind, "size": size} for name, (kind, size) in _DIMENSIONS.items()]
    for entry, scale, offset in zip(schema, SCALES, OFFSETS, strict=False):
        entry |= {"scale": scale, "offset": offset}
    index = {
        **{"version": "1.0.0", "dataType": data_type, "hierarchyType": "json", "points": count, "span": 128},
        **{"bounds": [0, 0, 0, 1, 1, 1], "boundsConforming": [0, 0, 0, 1, 1, 1], "schema": schema},
        **{"srs": {"authority": "EPSG", "horizontal": "32617", "wkt": UTM}},
    }
    (folder / "ept.json").write_text(json.dumps(index))
    return folder


def point_order(count=60):
    """Return the indices of the points in the order of the nodes."""
    return [i for k in range(len(NODES)) for i in range(k, count, len(NODES))]


def _record(i):
    _, _, _, intensity, returns, _, classification, _, _, source, time = values(6, i)
    return struct.pack("<3iHBBBHd", *integers(i), intensity, returns & 15, returns >> 4, classification, source, time)
