"""Loops run in a forked child with one thread, although it has none of its parent's threads."""

import os
import subprocess
import sys

import pytest
from optional import import_or_skip

FORKING_SCRIPT = """
import os
import numpy as np
{loop}
expected = compute()
child = os.fork()
if child == 0:
    os._exit(int(compute() != expected))
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
NEIGHBOR_SEARCH = """
from pcbench.geometry.neighbors import Index
points = np.random.default_rng(0).random((50_000, 3))
def compute():
    return Index(points).query(points, 4).distances.tobytes()
"""
RASTERIZATION = """
import torch
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from reconstructors.splat import rasterize
camera = Camera("view", Intrinsics.from_fov(64, 48, 60), look_at((0, -4, 0), (0, 0, 0)))
gaussians = torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 1, 3)
def compute():
    return rasterize(*gaussians, camera).color.numpy().tobytes()
"""


@pytest.mark.parametrize(
    "loop", [NEIGHBOR_SEARCH, pytest.param(RASTERIZATION, marks=pytest.mark.long)], ids=["neighbors", "splats"]
)
def test_loops_run_in_a_forked_child(loop):
    if loop is RASTERIZATION:
        import_or_skip("torch")
    environment = {**os.environ, "OMP_NUM_THREADS": "2"}
    script = FORKING_SCRIPT.format(loop=loop)
    process = subprocess.Popen([sys.executable, "-c", script], env=environment, start_new_session=True)
    try:
        assert process.wait(timeout=60) == 0
    finally:
        if process.poll() is None:
            os.killpg(process.pid, 9)
