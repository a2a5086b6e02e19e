"""The compiled rasterizer when memory runs out."""

import sys

import pytest
from kernel_scripts import run_with_rising_memory
from optional import import_or_skip

import_or_skip("torch")

SCRIPT = """
import sys
import numpy as np
from kernel_scripts import compute_with_rising_memory
from reconstructors.splat.cpu import _rasterizer

def splats(count, width, height):
    rng = np.random.default_rng(4)
    means = rng.uniform((-width / 2, -height / 2, 90), (width / 2, height / 2, 110), (count, 3)) / (100, 100, 100)
    quaternions = np.tile((1.0, 0, 0, 0), (count, 1))
    harmonics = rng.uniform(0, 1, (count, 1, 3))
    scales, opacities = np.full((count, 3), 0.05), np.full(count, 0.05)
    camera = np.eye(3), np.zeros(3), (100, 100, width / 2, height / 2), (-9, 9, -9, 9)
    cutoffs = 0.01, 1 / 255, np.log2(1 / 255), 1e-4
    numbers = means, quaternions, scales, opacities, harmonics, *camera, cutoffs
    images = np.zeros((height, width, 3)), np.zeros((height, width))
    arrays = [np.array(array, np.float32) for array in numbers]
    return *arrays, np.zeros(3, np.float32), *(np.array(image, np.float32) for image in images), None, None, None

def gradients(rasterizer, arguments):
    rows, (height, width) = rasterizer.drawn, arguments[11].shape[:2]
    rows_out = [np.empty((rows, *array.shape[1:]), np.float32) for array in arguments[:5]]
    screen = np.empty((rows, 2), np.float32)
    return np.ones((height, width, 3), np.float32), None, None, None, np.empty(rows, np.int64), *rows_out, screen

def run(operation, count, width, height):
    arguments = splats(count, width, height)
    if operation == "image_loss":
        image = arguments[11]
        image[:] = 0.5
        gradient = np.empty_like(image)
        return lambda: (_rasterizer.image_loss(image, 1 - image, 0.2, gradient), gradient.tobytes())[1]
    def run_pass():
        rasterizer = _rasterizer.Rasterizer()
        rasterizer.forward(*arguments)
        if operation == "forward":
            return arguments[11].tobytes()
        backward = gradients(rasterizer, arguments)
        rasterizer.backward(*backward)
        return backward[5].tobytes()
    return run_pass

operation, *size = sys.argv[1], *map(int, sys.argv[2:])
run(operation, 10, 64, 64)()  # starts all threads
compute = run(operation, *size)
failures, result = compute_with_rising_memory(compute)
print(failures, result == compute())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    ("operation", "size"),
    [("forward", (20_000, 96, 64)), ("backward", (5_000, 96, 64)), ("image_loss", (1, 30_000, 2))],
)
def test_running_out_of_memory_raises_a_memory_error(operation, size, threads):
    """Each large allocation fails once; the final result is that without a limit."""
    run_with_rising_memory(SCRIPT, operation, *size, threads=threads)
