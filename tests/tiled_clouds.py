"""Clouds in tiles for tests: stored from files, with the worker processes replaced by calls in random order."""

import pickle
from concurrent.futures import Future

import numpy as np

from pcbench.comparison import in_tiles
from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud
from pcbench.io.contents import FileState
from pcbench.io.pieces import open_cloud
from pcbench.measure.tiled.lattice import Lattice
from pcbench.measure.tiled.runs import CloudRuns, store_piece, tile_ranges
from pcbench.measure.tiled.tiles import TiledCloud, make_tile
from pcbench.tasks import runner
from pcbench.tasks.codec import decode, encode, result_type, types_in

ORIGIN = np.zeros(3)


def stored_runs(folder, points, *, piece_points=1000, step=7, lattice=None, normals=None):
    """Write points as a file, and store its pieces as runs; return these and the summaries of the pieces."""
    folder.mkdir(parents=True)
    file = folder / "cloud.ply"
    write_cloud(file, Cloud(points, normals=normals))
    cloud = open_cloud(file, piece_points=piece_points)
    lattice = lattice or Lattice.around(points.min(axis=0), points.max(axis=0))
    summaries, first_row = [], 0
    for piece in cloud.pieces:
        summaries.append(store_piece(cloud, piece, FileState.of(file), first_row, step, lattice, folder))
        first_row += piece.count
    return CloudRuns.of(folder, lattice, summaries), summaries


def stored_tiles(folder, points, most, *, region=None, pose=None, **options):
    """Store points as tiles with about at most that many points; return them."""
    runs, _ = stored_runs(folder / "runs", points, **options)
    (folder / "tiles").mkdir()
    return TiledCloud.of(
        folder / "tiles",
        [
            make_tile(runs.overlapping(codes), number, codes, ORIGIN, pose, region, folder / "tiles")
            for number, codes in enumerate(tile_ranges(runs, most))
        ],
    )


class ShuffledRunner:
    """Runs tasks in this process in random order, in place of `TaskRunner`; results are stored like those of workers.

    Attributes:
        calls: stage and name of each task that ran.
    """

    seed = 0

    def __init__(self, workers, folder, on_progress=None):
        self.folder, self.calls = folder, []
        self.rng = np.random.default_rng(self.seed)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def run(self, stage, function, tasks, *, key="", title="", skip=None):
        found, types = {}, types_in(result_type(function))
        for number in self.rng.permutation(len(tasks)):
            task = tasks[number]
            self.calls.append((stage, task.name))
            arguments = pickle.loads(pickle.dumps(task.arguments))
            try:
                found[task.name] = decode(encode(function(*arguments)), types)
            except InputError as error:
                if skip is None:
                    raise
                skip(task, error)
        return [(task, found[task.name]) for task in tasks if task.name in found]


def in_this_process(monkeypatch, seed=0):
    """Let comparisons in tiles run their tasks in this process, in a random order."""
    runner = type("SeededRunner", (ShuffledRunner,), {"seed": seed})
    monkeypatch.setattr(in_tiles, "TaskRunner", runner)


class CallsHere:
    """Runs the calls of `TaskRunner` in this process, in place of worker processes."""

    slots = 1

    def __init__(self, *_):
        pass

    def submit(self, call):
        outcome = Future()
        try:
            outcome.set_result(call.run())
        except Exception as error:
            outcome.set_exception(error)
        return outcome

    def keep_connected(self):
        pass

    stop = keep_connected


def with_stored_results(monkeypatch):
    """Let comparisons in tiles run their tasks in this process, and store their results as workers do."""
    monkeypatch.setattr(runner, "LocalWorkers", CallsHere)


def clouds_of_all_kinds(rng, count):
    """Yield names and points (N, 3) that are hard to divide into tiles."""
    flat = rng.random((count, 3)) * [10, 10, 1e-3]
    yield "flat", flat
    yield "grid", np.round(flat * [1, 1, 0], 1)  # equal distances, duplicates, and points on borders
    yield "outlier", np.concatenate([[[1e6, -2e6, 3.0]], flat, [[-5e5, 0, 0]]])
    holes = flat[(np.floor(flat[:, 0]) + np.floor(flat[:, 1])) % 2 == 0]
    yield "holes", holes
    yield "density", np.concatenate([flat, flat[: count // 2] * 1e-2])
    yield "volume", rng.normal(size=(count, 3))
    yield "line", rng.random((count, 1)) * [1.0, 2.0, 3.0]
    yield "equal", np.tile([[1.0, 2.0, 3.0]], (count, 1))
    yield "utm", flat + [500_000, 5_000_000, 100]
