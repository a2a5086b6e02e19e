"""Exports of Metashape's cameras, written as its manual describes them. Does not import pcbench."""

import numpy as np

IDENTITY = (np.eye(3), np.zeros(3), 1.0)


def export(
    cameras, chunk=IDENTITY, *, unaligned=(), lens=None, sensor_type="frame", with_transform=True, label="Chunk 1"
):
    """Return the XML of pcbench's cameras, of one sensor, in a chunk at (rotation, translation, scale)."""
    rotation, translation, scale = chunk
    k = cameras[0].intrinsics
    k1, k2, p1, p2 = k.distortion
    values = {"f": k.fy, "cx": k.cx - k.width / 2, "cy": k.cy - k.height / 2, "b1": k.fx - k.fy}
    values |= {"k1": k1, "k2": k2, "p1": p2, "p2": p1} | (lens or {})
    coefficients = "".join(f"<{name}>{value!r}</{name}>" for name, value in values.items())
    resolution = f'<resolution width="{k.width}" height="{k.height}"/>'
    elements = []
    for number, camera in enumerate(cameras):
        world_from_cam = camera.cam_from_world.inverse().matrix
        pose = np.eye(4)
        pose[:3, :3] = rotation.T @ world_from_cam[:3, :3]
        pose[:3, 3] = rotation.T @ (world_from_cam[:3, 3] - translation) / scale
        matrix = " ".join(map(repr, pose.ravel().tolist()))
        elements.append(
            f'<camera id="{number}" sensor_id="0" label="{camera.name.removesuffix(".png")}">'
            f"<transform>{matrix}</transform></camera>"
        )
    elements += [f'<camera id="{90 + k}" sensor_id="0" label="{name}"/>' for k, name in enumerate(unaligned)]
    numbers = " ".join(map(repr, rotation.ravel().tolist())), " ".join(map(repr, translation.tolist()))
    transform = (
        f"<transform><rotation>{numbers[0]}</rotation><translation>{numbers[1]}</translation>"
        f"<scale>{float(scale)!r}</scale></transform>"
    )
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="{label}" enabled="true">
<sensors next_id="1"><sensor id="0" label="test, 5 mm" type="{sensor_type}">{resolution}
<calibration type="{sensor_type}" class="initial">{resolution}<f>1</f></calibration>
<calibration type="{sensor_type}" class="adjusted">{resolution}{coefficients}</calibration></sensor></sensors>
<cameras next_id="9"><group id="0">{"".join(elements)}</group></cameras>{transform if with_transform else ""}
</chunk></document>
"""
