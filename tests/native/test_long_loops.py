"""Long loops of the compiled core end when Ctrl-C is pressed or memory runs out. No test waits for a clock."""

import _thread
import operator
import os
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from mesh_shapes import icosphere, triangle_soup
from repository import TESTS

from pcbench.native import _core
from reconstructors.mvs.native import _patchmatch


def assert_ctrl_c_stops(call):
    """Ctrl-C is pressed before `call`, a compiled function, runs; the interpreter comes to look at it only after.

    Both calls are made by `map`, so no bytecode runs between them and nothing but the compiled loop itself can raise
    the KeyboardInterrupt early. It looks twenty times a second: `call` must take longer than that. That it stopped
    early is seen in what it left unwritten, which is for the caller to assert.
    """
    with pytest.raises(KeyboardInterrupt):
        list(map(operator.call, (_thread.interrupt_main, call)))


def test_ctrl_c_stops_a_search():
    points = np.random.default_rng(12).uniform(-1, 1, (40_000, 3))
    index = _core.PointIndex(points)
    distances, indices = np.empty((len(points), 600)), np.full((len(points), 600), -1)
    # Seconds of work, where a twentieth of one is enough.
    assert_ctrl_c_stops(partial(index.knearest, points, distances, indices))
    assert (indices == -1).any()
    nearest, row = np.empty(9), np.empty(9, np.int64)
    index.nearest(points[:9], nearest, row)
    np.testing.assert_array_equal(row, np.arange(9))


def test_ctrl_c_stops_the_building():
    tree = _core.MeshIndex.__new__(_core.MeshIndex)
    # About a second of work, where a twentieth of one is enough.
    assert_ctrl_c_stops(partial(tree.__init__, *triangle_soup(500_000)))
    with pytest.warns(RuntimeWarning, match="uninitialized"), pytest.raises(TypeError):
        len(tree)


def from_the_center(count):
    """The tree of a sphere and `count` places at its centre: every triangle must be looked at for each of them."""
    vertices, faces = icosphere(5)
    return _core.MeshIndex(vertices, faces), np.zeros((count, 3))


def test_ctrl_c_stops_closest_points():
    tree, points = from_the_center(20_000)  # many seconds of work
    faces = np.full(len(points), -1)
    outputs = np.empty(len(points)), np.empty_like(points), faces, np.empty(len(points), np.uint8)
    assert_ctrl_c_stops(partial(tree.query, points, *outputs))
    assert (faces == -1).any()
    tree.query(points[:1], *(output[:1] for output in outputs))
    assert outputs[0][0] == pytest.approx(1, abs=0.01)  # the sphere has faces, not a curve


@pytest.mark.parametrize("what", ["cast", "blocked"])
def test_ctrl_c_stops_rays(what):
    vertices, faces = triangle_soup(100_000)
    tree = _core.MeshIndex(vertices, faces)
    origins = np.full((1_000_000, 3), -10.0)
    directions = np.random.default_rng(22).uniform(10, 11, origins.shape)
    distances, hits, flags = (
        np.full(len(origins), np.nan),
        np.empty(len(origins), np.int64),
        np.full(len(origins), 7, np.uint8),
    )
    if what == "cast":
        assert_ctrl_c_stops(partial(tree.cast, origins, directions, np.inf, distances, hits))
        assert np.isnan(distances).any()
    else:
        assert_ctrl_c_stops(partial(tree.blocked, origins, directions, np.inf, flags.view(np.bool_)))
        assert (flags == 7).any()


SHORT_OF_MEMORY = """
import resource, sys
from pathlib import Path
sys.path[:0] = {path!r}
from mesh_shapes import triangle_soup
from pcbench.native import _core
from reconstructors.mvs.native import _patchmatch

vertices, faces = triangle_soup(50_000)
_core.MeshIndex(*triangle_soup(10))  # all threads are there
failed, room = 0, 0
_, most = resource.getrlimit(resource.RLIMIT_AS)
while True:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + room, most))
    try:
        tree = _core.MeshIndex(vertices, faces)
        break
    except MemoryError:
        failed += 1
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    room += 1 << 18
print(failed, len(tree))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("threads", [1, 2])
def test_a_mesh_beyond_memory_is_a_memory_error(threads):
    """A little more memory each time, so that every allocation of the building is once the one that fails."""
    code = SHORT_OF_MEMORY.format(path=[str(TESTS)])
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "OMP_NUM_THREADS": str(threads)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    failed, size = map(int, done.stdout.split())
    assert failed > 3 and size == 50_000


def test_ctrl_c_stops_the_search_for_a_depth_map():
    gray = np.random.default_rng(3).integers(0, 255, (300, 400), np.uint8)
    pinhole, motion = np.array([400, 400, 200, 150], np.float32), np.eye(3, 4, dtype=np.float32)
    motion[0, 3] = 40
    matcher = _patchmatch.Matcher(gray, pinhole, None, 1.0, 10.0, 40.0, 1.0, 0)
    matcher.add_source(gray, motion, None, motion, None)
    planes, cost, views = (np.full((300, 400, n), -1, np.float32) for n in (4, 1, 1))
    # Many seconds of work.
    assert_ctrl_c_stops(partial(matcher.run, planes, cost[..., 0].copy(), views, 200))
