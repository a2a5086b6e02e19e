"""The reconstructor around the training: box, masks, held-out views, keys of checkpoints, limits and their errors."""

import shutil

import numpy as np
import pytest
import textured_corner as corner
from optional import import_or_skip
from PIL import Image
from wording import check_error, check_text

from pcbench.errors import ReconstructionError
from pcbench.geometry.cloud import Cloud
from pcbench.plugins import Reconstruction
from pcbench.scenes import read_scene
from pcbench.scenes.views import VIEWS_FOLDER, read_views

import_or_skip("torch")

from reconstructors.field import field as plugin  # noqa: E402
from reconstructors.field.train import load_field  # noqa: E402

QUICK_SETTINGS = {"steps": 90, "resolution": 32}
IMAGES = 9


class CornerPointsSfm:
    """Replaces `sfm`: points on the walls of the corner."""

    def __init__(self, **_):
        pass

    def reconstruct(self, scene, workspace):
        points = np.random.default_rng(4).uniform(0, corner.SIDE, (400, 3))
        points[np.arange(400), np.arange(400) % 3] = 0
        return Reconstruction(Cloud(points, unit="m"), "georeferenced", scene.cameras)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corner")
    return corner.write_scene(folder, corner.cameras(IMAGES, corner.standard_intrinsics(96, 72)))


@pytest.fixture
def train(tmp_path, monkeypatch, photographs):
    """Train with settings on photographs, some of which are completely hidden by masks."""
    monkeypatch.setattr(plugin, "ColmapSfm", CornerPointsSfm)
    (tmp_path / "work").mkdir()

    def run(masked_images=(), **settings):
        masks = tmp_path / f"masks_{len(masked_images)}"
        masks.mkdir(exist_ok=True)
        for number in masked_images:
            Image.fromarray(np.zeros((72, 96), np.uint8)).save(masks / f"{number:03}.png.png")
        scene = read_scene(photographs, masks=masks if masked_images else None)
        return plugin.RadianceField(**(QUICK_SETTINGS | settings)).reconstruct(scene, tmp_path / "work")

    return run


@pytest.mark.long
def test_the_surface_is_that_of_the_photographs(train, tmp_path):
    result = train(steps=600, resolution=64)
    points = result.cloud.points
    distances = np.abs(points).min(axis=1)
    assert len(points) > 1000 and np.median(distances) < 0.02 * corner.SIDE
    assert result.gauge == "georeferenced" and result.cloud.unit == "m"
    inside = (points > -0.1 * corner.SIDE).all(axis=1)
    assert inside.mean() > 0.95
    field = load_field(tmp_path / "work/model" / plugin.MODEL)
    check_text(next(note for note in result.notes if note.startswith(f"{len(field):,} vertices")))
    assert len(field) < 0.5 * field.links.size  # empty space is not stored


@pytest.mark.long
def test_renderings_of_held_out_images_are_better_than_a_gray_image(train, tmp_path):
    result = train(steps=300, hold_out="every")
    views = read_views(tmp_path / "work" / VIEWS_FOLDER).views
    assert sum(view.is_test for view in views) == 2 and len(views) == IMAGES
    shares = []  # of the variance that remain
    for images in (view.read() for view in views):
        photograph, rendering = (np.asarray(image, float) for image in (images.photograph, images.rendering))
        shares.append(np.mean((photograph - rendering) ** 2) / np.var(photograph, axis=(0, 1)).mean())
    # The voxels are larger than the finest texture, and the first image is held out, with neighbors on one side only.
    assert max(shares) < 0.9 and np.mean(shares) < 0.6
    check_text([note for note in result.notes if "held out" in note])
    train(steps=300)
    assert not (tmp_path / "work" / VIEWS_FOLDER).exists()


def test_masks_that_hide_all_photographs_are_refused(train):
    with check_error():
        train(masked_images=range(IMAGES))


def test_hidden_photographs_are_not_used(train, monkeypatch):
    used = []

    def interrupt(training, checkpoint, key):
        used.append([pyramid[0].name for pyramid in training._photographs])
        raise InterruptedError

    monkeypatch.setattr(plugin, "run_with_checkpoints", interrupt)
    with pytest.raises(InterruptedError):
        train(masked_images=[0, 3])
    assert len(used[0]) == IMAGES - 2 and "000.png" not in used[0]


def test_a_checkpoint_of_other_settings_or_photographs_is_not_resumed(train, monkeypatch):
    keys = []

    def interrupt(training, checkpoint, key):
        keys.append(key)
        raise InterruptedError

    monkeypatch.setattr(plugin, "run_with_checkpoints", interrupt)
    for masked_images, seed in (((), 0), ((2,), 0), ((), 1), ((), 0)):
        with pytest.raises(InterruptedError):
            train(masked_images, seed=seed)
    assert keys[0] == keys[3] and len(set(keys)) == 3


def test_a_note_says_that_transparent_photographs_lie_over_black(monkeypatch, photographs, tmp_path):
    folder = tmp_path / "transparent"
    shutil.copytree(photographs, folder)
    for image in sorted((folder / "images").iterdir())[:2]:
        with Image.open(image) as opaque:
            transparent = opaque.convert("RGBA")
        transparent.putalpha(Image.linear_gradient("L").resize(transparent.size))
        transparent.save(image)
    monkeypatch.setattr(plugin, "ColmapSfm", CornerPointsSfm)
    monkeypatch.setattr(plugin.extract, "surface", lambda *_: Cloud(np.zeros((1, 3))))
    (tmp_path / "work").mkdir()
    notes = plugin.RadianceField(**QUICK_SETTINGS).reconstruct(read_scene(folder), tmp_path / "work").notes
    check_text([note for note in notes if "transparent" in note])


def test_too_little_memory_is_refused(train, monkeypatch):
    """Before the grid is allocated."""
    monkeypatch.setattr(plugin.VoxelField, "dense", lambda *_: pytest.fail("a grid was allocated"))
    with check_error():
        train(memory=1e-6)


def test_voxels_stay_large_within_little_memory(train, monkeypatch, tmp_path):
    monkeypatch.setattr(plugin.extract, "surface", lambda *_: Cloud(np.zeros((1, 3))))
    notes = train(memory=0.002).notes
    check_text(next(note for note in notes if "memory" in note))
    assert max(load_field(tmp_path / "work/model" / plugin.MODEL).links.shape) < 33


@pytest.mark.parametrize(
    "settings",
    [
        {"steps": 0},
        {"resolution": 30},
        {"resolution": 8},
        {"image_side": 8},
        {"memory": 0.0},
        {"memory": float("nan")},
        {"seed": -1},
    ],
    ids=str,
)
def test_wrong_settings_are_refused(settings):
    with check_error(ValueError):
        plugin.RadianceField(**settings)


def test_too_few_images_are_refused_before_any_work(train, monkeypatch, photographs, tmp_path):
    monkeypatch.setattr(CornerPointsSfm, "reconstruct", lambda *_: pytest.fail("work was started"))
    scene = read_scene(photographs)
    for names, settings in ((2, {}), (8, {"hold_out": "every"})):
        with check_error():
            plugin.RadianceField(**settings).reconstruct(scene.select(scene.images[:names]), tmp_path / "work")


def test_a_single_sparse_point_bounds_no_field():
    with check_error(ReconstructionError):
        plugin.bounding_box(np.zeros((1, 3)))
