"""Images that share their intrinsics, and images with too few features."""

from pathlib import Path

from wording import check_error

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.scenes import Scene
from reconstructors.sfm.features import check_features, shared_intrinsics

K = Intrinsics(40, 30, 35, 35, 20, 15)
NAMES = ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg")


def make_scene(**known):
    return Scene(Path("photos"), NAMES, {**dict.fromkeys(NAMES, (40, 30)), "e.jpg": (30, 40)}, **known)


def test_images_of_the_same_intrinsics_or_size_share_a_camera():
    pose = look_at([1, 0, 1], [0, 0, 0])
    cameras = {"a.jpg": Camera("a.jpg", K, pose), "c.jpg": Camera("c.jpg", K, pose)}
    assert shared_intrinsics(make_scene(cameras=cameras)) == [
        (K, ("a.jpg", "c.jpg")),
        (None, ("b.jpg", "d.jpg")),
        (None, ("e.jpg",)),
    ]


def test_too_few_features_are_a_note_or_an_error():
    counts = dict.fromkeys(NAMES, 50)
    assert check_features(counts, make_scene()) == []
    assert check_features({**counts, "b.jpg": 49}, make_scene()) == ["1 of 5 images have fewer than 50 features: b.jpg"]
    single_count = {"a.jpg": 50}  # the database does not list images without a feature
    with check_error(ReconstructionError):
        check_features(single_count, make_scene())
