"""Scenes of OpenMVS, written as its interface format describes them."""

import struct

import numpy as np
from scene_folders import K, orbit

NO_POSE = 0xFFFFFFFF
POINTS = np.array([[1.0, 2, 3], [-1, 0.5, 0.25], [4, 5, 6]])
COLORS = np.array([[255, 10, 20], [1, 2, 3], [9, 8, 7]], np.uint8)
VIEWS = ([0, 1], [1, 2, 3], [2])


def numbers(code, values):
    return struct.pack(f"<{np.size(values)}{code}", *np.ravel(values).tolist())


def items(encoded_items):
    encoded_items = list(encoded_items)
    return struct.pack("<Q", len(encoded_items)) + b"".join(encoded_items)


def text(name):
    return struct.pack("<Q", len(name.encode())) + name.encode()


def views(images):
    return items(struct.pack("<If", image, 0.5) for image in images)


def scene_bytes(
    cameras,
    version=7,
    *,
    normalized=False,
    mount=None,
    transform=None,
    colors=COLORS,
    normals=None,
    has_pose=lambda k: True,
):
    """Return a scene in which each image has its own pose of one platform.

    Args:
        mount: rotation and centre of the camera on the platform.
        has_pose: whether the k-th image has a pose.
    """
    mount_rotation, center = mount or (np.eye(3), np.zeros(3))
    k = cameras[0].intrinsics
    matrix = np.array([[k.fx, 0, k.cx - 0.5], [0, k.fy, k.cy - 0.5], [0, 0, 1]])
    size = (0, 0) if normalized else (k.width, k.height)
    if normalized:
        matrix = np.diag([1 / max(k.width, k.height)] * 2 + [1]) @ matrix
    platform_camera = text("lens") + (text("") if version > 3 else b"") + struct.pack("<II", *size)
    platform_camera += numbers("d", matrix) + numbers("d", mount_rotation) + numbers("d", center)
    poses = []
    for camera in cameras:
        platform_rotation = mount_rotation.T @ camera.cam_from_world.rotation  # rotation of the platform
        poses.append(numbers("d", platform_rotation) + numbers("d", camera.position - platform_rotation.T @ center))
    images = []
    for number, camera in enumerate(cameras):
        image = text(f"undistorted\\{camera.name}") + (text("mask.png") if version > 4 else b"")
        image += struct.pack("<III", 0, 0, number if has_pose(number) else NO_POSE)
        image += struct.pack("<I", number) if version > 2 else b""
        image += numbers("f", [1, 2, 3]) + items([struct.pack("<II4f", 1, 9, 1, 0.1, 0.5, 2.0)]) if version > 6 else b""
        images.append(image)
    data = b"MVSI" + struct.pack("<II", version, 0)
    data += items([text("platform") + items([platform_camera]) + items(poses)]) + items(images)
    data += items(numbers("f", point) + views(image_ids) for point, image_ids in zip(POINTS, VIEWS, strict=True))
    data += items([] if normals is None else (numbers("f", normal) for normal in normals))
    data += items([] if colors is None else (bytes(color[::-1].tolist()) for color in colors))  # blue comes first
    data += (
        items([numbers("f", [0, 0, 0, 1, 1, 1]) + views([0, 1])]) + items([numbers("f", [0, 0, 1])]) + items([b"abc"])
    )
    data += numbers("d", np.eye(4) if transform is None else transform) if version > 1 else b""
    return data + (numbers("d", np.zeros(15)) if version > 5 else b"")


def corpus():
    cameras = orbit([f"{number}.png" for number in range(4)], K)
    return {
        "old": scene_bytes(cameras, 1, colors=None),
        "new": scene_bytes(cameras, 7, normals=np.eye(3)),
        "normalized": scene_bytes(cameras, 4, normalized=True),
    }
