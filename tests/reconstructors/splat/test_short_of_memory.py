"""The compiled rasterizer when memory runs out."""

import os
import subprocess
import sys

import pytest
from optional import import_or_skip

import_or_skip("torch")

CODE = """
import resource, sys
from pathlib import Path
import numpy as np
from reconstructors.splat.cpu import _rasterizer

def splats(count, width, height):
    rng = np.random.default_rng(4)
    means = rng.uniform((-width / 2, -height / 2, 90), (width / 2, height / 2, 110), (count, 3)) / (100, 100, 100)
    quaternions = np.tile((1.0, 0, 0, 0), (count, 1))
    harmonics = rng.uniform(0, 1, (count, 1, 3))
    scales, opacities = np.full((count, 3), 0.05), np.full(count, 0.05)
    camera = np.eye(3), np.zeros(3), (100, 100, width / 2, height / 2), (-9, 9, -9, 9)
    numbers = means, quaternions, scales, opacities, harmonics, *camera
    images = np.zeros((height, width, 3)), np.zeros((height, width))
    given = [np.array(array, np.float32) for array in numbers]
    return *given, 0.01, np.zeros(3, np.float32), *(np.array(image, np.float32) for image in images), None, None, None

def gradients(rasterizer, arguments):
    rows, (height, width) = rasterizer.drawn, arguments[11].shape[:2]
    out = [np.empty((rows, *array.shape[1:]), np.float32) for array in arguments[:5]]
    rest = [np.empty((rows, 2), np.float32), np.empty(rows, np.float32), np.empty(rows, np.float32)]
    return np.ones((height, width, 3), np.float32), None, None, None, None, np.empty(rows, np.int64), *out, *rest

def run(what, count, width, height):
    arguments = splats(count, width, height)
    if what == "image_loss":
        image = arguments[11]
        image[:] = 0.5
        gradient = np.empty_like(image)
        return lambda: (_rasterizer.image_loss(image, 1 - image, 0.2, gradient), gradient.tobytes())[1]
    def pass_():
        rasterizer = _rasterizer.Rasterizer()
        rasterizer.forward(*arguments)
        if what == "forward":
            return arguments[11].tobytes()
        backward = gradients(rasterizer, arguments)
        rasterizer.backward(*backward)
        return backward[6].tobytes()
    return pass_

what, *size = sys.argv[1], *map(int, sys.argv[2:])
run(what, 10, 64, 64)()  # starts all threads
work = run(what, *size)
failed, room = 0, 0
_, most = resource.getrlimit(resource.RLIMIT_AS)
while True:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + room, most))
    try:
        result = work()
        break
    except MemoryError:
        failed += 1
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    room += 1 << 18
print(failed, result == work())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    ("what", "size"), [("forward", (20_000, 96, 64)), ("backward", (5_000, 96, 64)), ("image_loss", (1, 30_000, 2))]
)
def test_running_out_of_memory_raises_a_memory_error(what, size, threads):
    """The limit rises in small steps, so that each large allocation fails once; the final result is that without a
    limit."""
    done = subprocess.run(
        [sys.executable, "-c", CODE, what, *map(str, size)],
        env={**os.environ, "OMP_NUM_THREADS": str(threads)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    failed, same = done.stdout.split()
    assert int(failed) > 3 and same == "True"
