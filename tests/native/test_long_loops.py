"""Long loops of the compiled core stop on Ctrl-C or when memory runs out. No test depends on timing."""

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
    """Assert that Ctrl-C, pressed before the compiled function `call` runs, stops it.

    `map` makes both calls, so no bytecode runs between them, and only the compiled loop itself can raise
    KeyboardInterrupt early. The loop checks twenty times a second, so `call` must take longer than that. The caller
    asserts that part of the output was left unwritten.
    """
    with pytest.raises(KeyboardInterrupt):
        list(map(operator.call, (_thread.interrupt_main, call)))


def test_ctrl_c_stops_a_search():
    points = np.random.default_rng(12).uniform(-1, 1, (40_000, 3))
    index = _core.PointIndex(points)
    distances, indices = np.empty((len(points), 600)), np.full((len(points), 600), -1)
    # Takes seconds; a twentieth of a second is enough.
    assert_ctrl_c_stops(partial(index.knearest, points, distances, indices))
    assert (indices == -1).any()
    nearest, row = np.empty(9), np.empty(9, np.int64)
    index.nearest(points[:9], None, nearest, row)
    np.testing.assert_array_equal(row, np.arange(9))


def test_ctrl_c_stops_the_construction_of_a_mesh_index():
    tree = _core.MeshIndex.__new__(_core.MeshIndex)
    # Takes about a second; a twentieth of a second is enough.
    assert_ctrl_c_stops(partial(tree.__init__, *triangle_soup(500_000)))
    with pytest.warns(RuntimeWarning, match="uninitialized"), pytest.raises(TypeError):
        len(tree)


def sphere_queries(count):
    """The tree of a sphere and `count` queries at its centre, each of which must visit every triangle."""
    vertices, faces = icosphere(5)
    return _core.MeshIndex(vertices, faces), np.zeros((count, 3))


def test_ctrl_c_stops_closest_point_queries():
    tree, points = sphere_queries(20_000)  # takes many seconds
    faces = np.full(len(points), -1)
    outputs = np.empty(len(points)), np.empty_like(points), faces, np.empty(len(points), np.uint8)
    assert_ctrl_c_stops(partial(tree.query, points, *outputs))
    assert (faces == -1).any()
    tree.query(points[:1], *(output[:1] for output in outputs))
    assert outputs[0][0] == pytest.approx(1, abs=0.01)  # the faces are chords of the sphere


@pytest.mark.parametrize("method", ["cast", "blocked"])
def test_ctrl_c_stops_ray_casting(method):
    vertices, faces = triangle_soup(100_000)
    tree = _core.MeshIndex(vertices, faces)
    origins = np.full((1_000_000, 3), -10.0)
    directions = np.random.default_rng(22).uniform(10, 11, origins.shape)
    distances, hits, flags = (
        np.full(len(origins), np.nan),
        np.empty(len(origins), np.int64),
        np.full(len(origins), 7, np.uint8),
    )
    if method == "cast":
        assert_ctrl_c_stops(partial(tree.cast, origins, directions, np.inf, distances, hits))
        assert np.isnan(distances).any()
    else:
        assert_ctrl_c_stops(partial(tree.blocked, origins, directions, np.inf, flags.view(np.bool_)))
        assert (flags == 7).any()


LIMITED_MEMORY_SCRIPT = """
import resource, sys
from pathlib import Path
sys.path[:0] = {path!r}
from mesh_shapes import triangle_soup
from pcbench.native import _core
from reconstructors.mvs.native import _patchmatch

vertices, faces = triangle_soup(50_000)
_core.MeshIndex(*triangle_soup(10))  # starts all threads
failures, spare_bytes = 0, 0
_, hard_limit = resource.getrlimit(resource.RLIMIT_AS)
while True:
    used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used_bytes + spare_bytes, hard_limit))
    try:
        tree = _core.MeshIndex(vertices, faces)
        break
    except MemoryError:
        failures += 1
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (hard_limit, hard_limit))
    spare_bytes += 1 << 18
print(failures, len(tree))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("threads", [1, 2])
def test_a_mesh_beyond_memory_raises_memory_error(threads):
    """Memory grows in small steps, so that each allocation of the construction fails once."""
    script = LIMITED_MEMORY_SCRIPT.format(path=[str(TESTS)])
    process = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "OMP_NUM_THREADS": str(threads)},
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr
    failures, face_count = map(int, process.stdout.split())
    assert failures > 3 and face_count == 50_000


def test_ctrl_c_stops_patchmatch():
    gray = np.random.default_rng(3).integers(0, 255, (300, 400), np.uint8)
    pinhole, motion = np.array([400, 400, 200, 150], np.float32), np.eye(3, 4, dtype=np.float32)
    motion[0, 3] = 40
    matcher = _patchmatch.Matcher(gray, pinhole, None, 1.0, 10.0, 40.0, 1.0, False, 0)
    matcher.add_source(gray, motion, None, motion, None)
    planes, cost, views = (np.full((300, 400, n), -1, np.float32) for n in (4, 1, 1))
    # Takes many seconds.
    assert_ctrl_c_stops(partial(matcher.run, planes, cost[..., 0].copy(), views, 200))
