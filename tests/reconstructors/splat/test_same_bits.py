"""The CPU's rasterizer, loss and optimizer give the same bits at any number of threads and on every instruction set."""

import json
import os
import subprocess
import sys

import pytest
from optional import import_or_skip
from repository import TESTS

import_or_skip("torch")

DIGEST_SCRIPT = """
import hashlib, json, sys
import numpy as np, torch
sys.path[:0] = {path!r}
from splat_passes import Engine, random_image_gradients, run_pass
from splat_scenes import SCENES, make_scene, scattered_cloud
from reconstructors.splat import cpu
from reconstructors.splat.cpu import _rasterizer

digests = {{}}
def add_digest(name, *arrays):
    digests[name] = hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()

engine, rng = Engine(cpu, "cpu"), np.random.default_rng(1)
for kind in SCENES:
    scene = make_scene(kind)
    add_digest(kind.__name__, *run_pass(engine, scene, random_image_gradients(scene)).arrays().values())
    image_gradients = random_image_gradients(scene)._replace(normal=None)
    add_digest(kind.__name__ + " depth", *run_pass(engine, scene, image_gradients, normals=False).arrays().values())
    image_gradients = image_gradients._replace(depth=None)
    add_digest(kind.__name__ + " plain", *run_pass(engine, scene, image_gradients, geometry=False).arrays().values())
# Enough Gaussians and tiles for several threads.
many = scattered_cloud(rng, 3000, 210, 130, size=0.06)
add_digest("many", *run_pass(engine, many, random_image_gradients(many)).arrays().values())
image, target = (torch.from_numpy(rng.random((131, 207, 3), np.float32)) for _ in range(2))
loss = cpu.image_loss(image, target, 0.2)
add_digest("loss", float(loss.l1), float(loss.ssim), loss.gradient.numpy())
rows = [torch.from_numpy(rng.random((5000, 48), np.float32)) for _ in range(3)]
ids = np.flatnonzero(rng.random(5000) < 0.7)
cpu.adam(*rows, torch.from_numpy(rng.normal(size=(len(ids), 48)).astype(np.float32)), torch.from_numpy(ids), 0.01, 3)
add_digest("adam", *(row.numpy() for row in rows))
print(json.dumps([_rasterizer.isa(), digests]))
"""


def run_digest_script(**environment):
    """Return the results of a fresh process."""
    script = DIGEST_SCRIPT.format(path=[str(TESTS)])
    return subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, **environment}, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def baseline_digests():
    process = run_digest_script(PCBENCH_ISA="baseline", OMP_NUM_THREADS="1")
    assert process.returncode == 0, process.stderr
    isa, digests = json.loads(process.stdout)
    assert isa == "baseline"
    return digests


@pytest.mark.long
@pytest.mark.parametrize("isa, threads", [("avx2", "2"), ("avx512", "3")])
def test_threads_and_instruction_sets_give_the_same_bits(baseline_digests, isa, threads):
    """As one thread of the baseline; on a machine without these instructions, several threads of the baseline."""
    process = run_digest_script(PCBENCH_ISA=isa, OMP_NUM_THREADS=threads)
    if "PCBENCH_ISA: expected an instruction set that this machine supports" in process.stderr:
        isa, process = "baseline", run_digest_script(PCBENCH_ISA="baseline", OMP_NUM_THREADS=threads)
    assert json.loads(process.stdout) == [isa, baseline_digests], process.stderr
