"""The CPU's rasterizer, loss and optimizer give the same bits at any number of threads and on every instruction set."""

import pytest
from kernel_scripts import baseline_digest, check_same_bits
from optional import import_or_skip

import_or_skip("torch")

DIGEST_SCRIPT = """
import hashlib, json, sys
import numpy as np, torch
from splat_passes import Engine, random_image_gradients, run_pass
from splat_scenes import SCENES, make_scene, scattered_cloud
from reconstructors.splat import cpu
from reconstructors.splat.cpu import _rasterizer

digests = {}
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


@pytest.fixture(scope="module")
def digest():
    return baseline_digest(DIGEST_SCRIPT)


@pytest.mark.long
@pytest.mark.parametrize("isa, threads", [("avx2", "2"), ("avx512", "3")])
def test_threads_and_instruction_sets_give_the_same_bits(digest, isa, threads):
    """As one thread of the baseline."""
    check_same_bits(DIGEST_SCRIPT, digest, isa, threads)
