"""Training block by block: each Gaussian and each point belongs to exactly one block, and a killed run resumes."""

import math
from dataclasses import replace

import numpy as np
import pytest
import textured_corner as corner
from optional import import_or_skip
from PIL import Image
from wording import check_error, check_text

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.visibility import in_frame
from pcbench.scenes import read_scene

torch = import_or_skip("torch")

from reconstructors.mvs.cells import SPACE  # noqa: E402
from reconstructors.splat import splat as plugin  # noqa: E402
from reconstructors.splat.blocks import TrainedBlock, TrainingBlock, merge_models, plan_blocks  # noqa: E402
from reconstructors.splat.exposure import read_gains  # noqa: E402
from reconstructors.splat.model import Gaussians, LocalFrame  # noqa: E402
from reconstructors.splat.ply import read_model  # noqa: E402
from reconstructors.splat.resume import load_model  # noqa: E402
from reconstructors.splat.train import render  # noqa: E402
from reconstructors.splat.view import View  # noqa: E402

K = Intrinsics.from_fov(60, 40, 40)


def strip(length=100.0, count=50):
    """Return points of a strip of ground and cameras above it; each shows 13 of its length."""
    points = np.random.default_rng(0).uniform([0, -3, 0], [length, 3, 1], (4000, 3))
    xs = np.linspace(0, length, count)
    return points, {f"{x:05.1f}.png": Camera(f"{x:05.1f}.png", K, look_at([x, 0, 12], [x, 0.01, 0])) for x in xs}


@pytest.mark.parametrize("max_images", [15, 30])
def test_blocks_have_the_photographs_and_the_points_that_they_need(max_images):
    points, cameras = strip()
    blocks = plan_blocks(points, cameras, lambda share, names: len(names) <= max_images, seed=0)
    assert len(blocks) > 50 / max_images
    assert (sum(block.cell.contains(points).astype(int) for block in blocks) == 1).all()
    assert {name for block in blocks for name in block.images} == set(cameras)
    for block in blocks:
        assert 3 <= len(block.images) <= max_images
        own = points[block.cell.contains(points)]
        # Each photograph from over the cell belongs to the block, and none whose image does not reach it.
        x = np.array([float(name[:5]) for name in cameras])
        over = (x >= own[:, 0].min()) & (x <= own[:, 0].max())
        assert set(np.array(list(cameras))[over]) <= set(block.images)
        assert all(in_frame(cameras[name], own).any() for name in block.images)
        # Training starts at all points in and around the cell, and at most as many beyond.
        start = np.zeros(len(points), bool)
        start[block.start] = True
        inner = block.surroundings.contains(points)
        assert start[inner].all() and inner[block.cell.contains(points)].all()
        assert start.sum() == len(block.start) <= 2 * inner.sum()
        assert block.share == len(block.start) / len(points)


def test_cells_get_only_photographs_that_see_them():
    """Five cameras leave gaps; cameras that look at the sky see nothing."""
    points, cameras = strip(count=5)
    sky = {f"sky{k}.png": Camera(f"sky{k}.png", K, look_at([k, 0, 12], [k, 0.01, 24])) for k in range(4)}
    blocks = plan_blocks(points, sky | cameras, lambda share, _: share < 0.1, seed=0)
    assert {name for block in blocks for name in block.images} == set(cameras)
    for block in blocks:
        own = points[block.cell.contains(points)]
        assert set(block.images) == {name for name, camera in cameras.items() if in_frame(camera, own).any()}
    assert () in [block.images for block in blocks]


def test_memory_cannot_split_below_a_few_points():
    points, cameras = strip()
    blocks = plan_blocks(points, cameras, lambda *_: False, seed=0)
    assert all(block.cell.contains(points).sum() >= 25 for block in blocks)


def random_model(count):
    """Return Gaussians of degree 3 in a box about the origin."""
    rng = np.random.default_rng(2)
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 16, 3))
    means, quats, scales, logits, sh = (torch.from_numpy(rng.normal(0, 0.3, s).astype(np.float32)) for s in shapes)
    return Gaussians(means, quats, scales - 2.5, logits, sh)


def test_models_of_blocks_are_merged_without_duplicates_and_losses():
    """Two blocks that found the same Gaussians, in different frames, give these Gaussians."""
    model = random_model(200)
    frame = LocalFrame(np.array([10.0, 20, 30]), 2.0)
    world = frame.to_world(model.means.numpy())
    cells = [
        part
        for half in SPACE.split(0, float(np.median(world[:, 0])))
        for part in half.split(1, float(np.median(world[:, 1])))
    ]
    blocks = []
    for k, cell in enumerate(cells):
        own = LocalFrame(frame.origin + k, 1.0 + k)
        means = torch.from_numpy(own.to_local(world).astype(np.float32))
        log_scales = model.log_scales + math.log(frame.unit / own.unit)
        lower = model.sh if k else torch.zeros_like(model.sh)[:, :4] + model.sh[:, :4]
        blocks.append(TrainedBlock(replace(model, means=means, log_scales=log_scales, sh=lower), own, cell))
    merged = merge_models(iter(blocks), frame)
    assert len(merged) == len(model) and merged.degree == model.degree
    inside = [cell.contains(world) for cell in cells]
    order = np.concatenate([np.flatnonzero(rows) for rows in inside])
    np.testing.assert_allclose(merged.means, model.means[order], atol=1e-5)
    np.testing.assert_allclose(merged.log_scales, model.log_scales[order], atol=1e-5)
    np.testing.assert_array_equal(merged.quats, model.quats[order])
    first = int(inside[0].sum())
    np.testing.assert_array_equal(merged.sh[first:], model.sh[order][first:])
    np.testing.assert_array_equal(merged.sh[:first, :4], model.sh[order][:first, :4])
    assert not merged.sh[:first, 4:].any()
    view = View.of(Camera("", K, look_at([0, -4, 0.5], [0, 0, 0])), 0.01)
    upper = merge_models([block._replace(cell=SPACE) for block in blocks[1:2]], frame)
    np.testing.assert_allclose(render(upper, view), render(model, view), atol=1e-3)
    with check_error(ReconstructionError):
        merge_models([block._replace(cell=SPACE.split(0, -1e9)[0]) for block in blocks], frame)


@pytest.fixture
def train(tmp_path, monkeypatch):
    """Train with settings on nine photographs, with memory for less than all Gaussians."""
    monkeypatch.setattr(plugin, "ColmapSfm", corner.RandomPointsSfm)
    (tmp_path / "corner").mkdir()
    corner.write_scene(tmp_path / "corner", corner.cameras(9, corner.standard_intrinsics(64, 48)))

    def run(work="work", masks=None, **settings):
        (tmp_path / work).mkdir(exist_ok=True)
        quick = {"start": "sfm", "supervision": "none", "steps": 12, "gaussians": 400, "sh_degree": 0, "cloud": "means"}
        settings = {**quick, "density": "fixed", "memory": 4.5e-4, **settings}
        scene = read_scene(tmp_path / "corner", masks=masks)
        return plugin.GaussianSplatting(**settings).reconstruct(scene, tmp_path / work)

    return run


def block_folders(work):
    return sorted((work / "blocks").iterdir())


def test_a_scene_that_needs_more_memory_is_trained_in_blocks(train, tmp_path):
    reconstruction = train(hold_out="every", exposure=True)
    (note,) = [note for note in reconstruction.notes if "blocks" in note]
    folders = block_folders(tmp_path / "work")
    assert f"trained in {len(folders)} blocks of at most 9 photographs" in check_text(note)
    assert len(folders) > 1
    # The model has the Gaussians of all blocks, each in the cell of its block.
    merged, frame = read_model(tmp_path / "work/model/point_cloud.ply")
    counts = [len(load_model(folder / "model.pt")) for folder in folders]
    assert len(reconstruction.cloud) == len(merged) < sum(counts)
    assert 350 < len(merged) < 450  # the others are of the surroundings
    assert max(counts) < 400
    means = frame.to_world(merged.means.numpy())
    np.testing.assert_allclose(means, reconstruction.cloud.points, atol=1e-5)
    gains = read_gains(tmp_path / "work/model/gains.csv")
    assert sorted(gains) == [f"{k:03}.png" for k in range(1, 8)]
    assert (tmp_path / "work/rendered").is_dir()
    # With enough memory, the scene is trained at once, and the blocks are removed.
    notes = train(memory=4.0).notes
    assert not any("blocks" in note for note in notes)
    assert not (tmp_path / "work/blocks").exists()


def test_a_killed_run_resumes_with_the_next_block(train, tmp_path, monkeypatch):
    expected = train("other").cloud.points
    run, trained = plugin.run_with_checkpoints, []

    def interrupt_second(training, checkpoint, key, show):
        trained.append(key)
        if len(trained) == 2:
            raise InterruptedError
        return run(training, checkpoint, key, show)

    monkeypatch.setattr(plugin, "run_with_checkpoints", interrupt_second)
    with pytest.raises(InterruptedError):
        train()
    assert len(block_folders(tmp_path / "work")) == 1 + 1  # and a partial one
    resumed = train().cloud.points
    np.testing.assert_array_equal(resumed, expected)
    blocks = len(block_folders(tmp_path / "work"))
    assert len(trained) == 2 + blocks - 1
    assert trained[2] == trained[1] != trained[0]
    train()
    assert len(trained) == 1 + blocks


def test_too_many_photographs_for_any_block_are_refused(train):
    with check_error():
        train(memory=1e-4)


def two_blocks(monkeypatch, first_images, second_images):
    """Plan two blocks of given images, split at the middle of the corner."""
    cells = SPACE.split(0, corner.SIDE / 2)

    def plan(points, *_):
        starts = [np.flatnonzero(cell.contains(points)) for cell in cells]
        images = (first_images, second_images)
        return [
            TrainingBlock(cell, cell, names, start, len(start) / len(points))
            for cell, names, start in zip(cells, images, starts, strict=True)
        ]

    monkeypatch.setattr(plugin, "plan_blocks", plan)
    return cells


def test_the_number_of_gaussians_is_optimized_in_each_block_with_enough_photographs(train, tmp_path, monkeypatch):
    names = tuple(f"{k:03}.png" for k in range(9))
    two_blocks(monkeypatch, names, names[:3])
    reconstruction = train(density="parsimonious", steps=30, memory=8e-4)
    check_text(next(note for note in reconstruction.notes if "optimized in each block" in note))
    first, second = block_folders(tmp_path / "work")
    assert (first / "curve.csv").is_file() and not (second / "curve.csv").exists()
    assert not (tmp_path / "work/model/curve.csv").exists()


def test_the_merged_model_follows_the_cells(train, tmp_path, monkeypatch):
    """The same blocks with other cells are not trained again, but merged again."""
    names = tuple(f"{k:03}.png" for k in range(9))
    two_blocks(monkeypatch, names, names)
    first = train().cloud
    plan = plugin.plan_blocks
    cells = SPACE.split(0, corner.SIDE / 3)
    monkeypatch.setattr(
        plugin, "plan_blocks", lambda *a: [b._replace(cell=c) for b, c in zip(plan(*a), cells, strict=True)]
    )
    monkeypatch.setattr(plugin, "run_with_checkpoints", lambda *_: pytest.fail("a block was trained again"))
    assert len(train().cloud) < len(first)


def test_a_block_without_training_photographs_is_left_out(train, tmp_path, monkeypatch):
    names = tuple(f"{k:03}.png" for k in range(9))
    cells = two_blocks(monkeypatch, names[:3], names[3:])
    (tmp_path / "masks").mkdir()
    for name in names[:3]:
        Image.fromarray(np.zeros((48, 64), np.uint8)).save(tmp_path / f"masks/{name}.png")
    reconstruction = train(masks=tmp_path / "masks")
    check_text(next(note for note in reconstruction.notes if "no training photographs" in note))
    assert cells[1].contains(reconstruction.cloud.points).all()
    assert len(block_folders(tmp_path / "work")) == 1
    two_blocks(monkeypatch, names[:1], names[1:3])
    with check_error():
        train("hidden", masks=tmp_path / "masks")


def test_each_block_yields_the_surface_in_its_cell(train, monkeypatch):
    """One block is of three photographs; a block without a surface is a note, and no surface at all an error."""
    names = tuple(f"{k:03}.png" for k in range(9))
    cells = two_blocks(monkeypatch, names[:3], names)
    points = np.random.default_rng(1).uniform(0, corner.SIDE, (500, 3))
    images = []

    def surface(model, frame, pinholes, cell):
        assert isinstance(model, Gaussians)
        images.append(len(pinholes))
        return Cloud(
            points, np.ones_like(points), np.zeros(points.shape, np.uint8), {"views": np.full(500, len(pinholes))}
        )

    monkeypatch.setattr(plugin.extract, "surface", surface)
    cloud = train(cloud="surface").cloud
    assert images == [3, 9]
    assert len(cloud) == 500
    np.testing.assert_array_equal(np.sort(cloud.points, axis=0), np.sort(points, axis=0))
    np.testing.assert_array_equal(cloud.attributes["views"], np.where(cells[0].contains(cloud.points), 3, 9))

    def no_surface(*_, **__):
        raise ReconstructionError("no surface")

    monkeypatch.setattr(
        plugin.extract, "surface", lambda *arguments, **cell: (surface, no_surface)[len(images) % 2](*arguments, **cell)
    )
    reconstruction = train(cloud="surface")
    check_text(next(note for note in reconstruction.notes if "have no surface" in note))
    assert cells[0].contains(reconstruction.cloud.points).all()
    # A block of a single photograph is trained, but three must agree on a surface.
    monkeypatch.setattr(plugin.extract, "surface", surface)
    cells = two_blocks(monkeypatch, names[:1], names)
    reconstruction = train("single", cloud="surface")
    assert any("have no surface" in note for note in reconstruction.notes)
    assert cells[1].contains(reconstruction.cloud.points).all()
    assert cells[0].contains(train("single").cloud.points).any()
    monkeypatch.setattr(plugin.extract, "surface", no_surface)
    with check_error(ReconstructionError):
        train(cloud="surface")
