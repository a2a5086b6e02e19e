"""The emulator of CUDA kernels on the CPU: it computes what a GPU computes, and detects undefined behaviour."""

import ctypes
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from optional import import_or_skip

torch = import_or_skip("torch")
cuda_emulator = pytest.importorskip("cuda_emulator")


@dataclass(frozen=True)
class KernelSource:
    """A kernel given as source, with 64 threads per block by default."""

    source: str
    threads: int = 64
    name: str = "kernel"


def run(kernel, *arguments, blocks=1, order="forward", seed=0):
    cuda_emulator.Emulator(order, seed).launch(kernel, blocks, *arguments)


def run_in_all_orders(kernel, make_arguments, blocks=1):
    """Return the first argument after the kernel has run, for each order of threads and blocks."""
    results = []
    for order, seed in cuda_emulator.ORDERS:
        arguments = make_arguments()
        run(kernel, *arguments, blocks=blocks, order=order, seed=seed)
        results.append(arguments[0].clone())
    return results


SUM_KERNEL = """
extern "C" __global__ void kernel(int* out, const int* values) {
    __shared__ int warps[2];
    int value = values[blockIdx.x * 64 + threadIdx.x];
    for (int by = 16; by > 0; by /= 2) value += __shfl_down_sync(0xffffffffu, value, by);
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = value;
    BARRIER
    if (threadIdx.x == 0) atomicAdd(out, warps[0] + warps[1]);
}
"""


def test_a_sum_over_blocks_is_correct_in_every_order():
    values = torch.randint(0, 1000, (5 * 64,), dtype=torch.int32, generator=torch.Generator().manual_seed(1))
    kernel = KernelSource(SUM_KERNEL.replace("BARRIER", "__syncthreads();"))
    results = run_in_all_orders(kernel, lambda: (torch.zeros(1, dtype=torch.int32), values), blocks=5)
    assert [int(result) for result in results] == [int(values.sum())] * 4


def test_a_missing_barrier_makes_the_result_depend_on_the_order():
    """One run may be correct. The result differs between orders, and shared memory is overwritten before each block."""
    values = torch.ones(64, dtype=torch.int32)
    kernel = KernelSource(SUM_KERNEL.replace("BARRIER", ""))
    results = run_in_all_orders(kernel, lambda: (torch.zeros(1, dtype=torch.int32), values))
    assert len({int(result) for result in results}) > 1


def test_shared_memory_is_lost_between_blocks():
    kernel = KernelSource("""
    extern "C" __global__ void kernel(float* out) {
        __shared__ float kept;
        if (blockIdx.x == 0) kept = 1.0f;
        __syncthreads();
        if (threadIdx.x == 0) out[blockIdx.x] = kept;
    }""")
    out = torch.zeros(2)
    run(kernel, out, blocks=2)
    assert out[0] == 1 and torch.isnan(out[1])


LANES = np.tile(np.arange(32), 2)


WARP_OPERATIONS = [
    ("__shfl_sync(0xffffffffu, lane * lane, 5)", np.full(64, 25)),
    ("__shfl_sync(0xffffffffu, lane * lane, (lane + 1) % 32)", ((LANES + 1) % 32) ** 2),
    ("__shfl_up_sync(0xffffffffu, lane, 3)", np.where(LANES < 3, LANES, LANES - 3)),
    ("__shfl_down_sync(0xffffffffu, lane, 3)", np.where(LANES > 28, LANES, LANES + 3)),
    ("__shfl_xor_sync(0xffffffffu, lane, 8)", LANES ^ 8),
    ("__float_as_int(__shfl_xor_sync(0xffffffffu, 1.0f * lane, 1))", (LANES ^ 1).astype(np.float32).view(np.int32)),
    ("__popc(__ballot_sync(0xffffffffu, lane < 7))", np.full(64, 7)),
    ("__any_sync(0xffffffffu, threadIdx.x == 40)", np.repeat([0, 1], 32)),
    ("__all_sync(0xffffffffu, threadIdx.x != 40)", np.repeat([1, 0], 32)),
    ("__reduce_add_sync(0xffffffffu, threadIdx.x)", np.repeat([496, 1520], 32)),
    ("__popc(__match_any_sync(0xffffffffu, lane / 5))", np.where(LANES < 30, 5, 2)),
    ("__syncthreads_count(lane < 3)", np.full(64, 6)),
    ("__syncthreads_or(threadIdx.x == 40)", np.ones(64)),
    ("__syncthreads_and(threadIdx.x != 40)", np.zeros(64)),
    # The halves of a warp separately, the upper one twice.
    (
        "lane < 16 ? __shfl_sync(0xffffu, lane, 3)"
        " : __shfl_sync(0xffff0000u, __shfl_sync(0xffff0000u, lane, 20) + lane, 17)",
        np.where(LANES < 16, 3, 37),
    ),
    # 1 if the fused operation rounds once, else 0.
    ("__fmaf_rn(16777215.0f, 16777215.0f, -281474943156224.0f)", np.ones(64)),
]


def test_warp_and_block_operations():
    lines = (f"out[{64 * n} + threadIdx.x] = {expression};" for n, (expression, _) in enumerate(WARP_OPERATIONS))
    kernel_body = "const int lane = threadIdx.x % 32;\n" + "\n".join(lines)
    kernel = KernelSource('extern "C" __global__ void kernel(int* out) {' + kernel_body + "}")
    for result in run_in_all_orders(kernel, lambda: (torch.full((len(WARP_OPERATIONS), 64), -9, dtype=torch.int32),)):
        for row, (expression, expected) in zip(result, WARP_OPERATIONS, strict=True):
            np.testing.assert_array_equal(row.numpy(), expected, err_msg=expression)


UNDEFINED_OPERATIONS = [
    ("if (threadIdx.x < 32) __syncthreads();", "ended"),
    ("if (threadIdx.x == 3) return; __syncthreads();", "ended"),
    ("if (threadIdx.x < 32)\n __syncthreads();\n else\n __syncthreads();", "divergent barrier"),
    ("if (threadIdx.x % 2)\n __syncthreads();\n else\n __syncwarp(0x55555555u);", "divergent barrier|ended"),
    ("if (threadIdx.x != 3) __syncwarp();", "has ended|divergent barrier"),
    ("if (threadIdx.x % 2)\n __syncwarp();\n else\n __any_sync(0xffffffffu, 1);", "divergent warp"),
    ("__syncwarp(0xffff0000u);", "not in the mask"),
    ("if (threadIdx.x % 32 < 16) __shfl_sync(0x0000ffffu, 1, 20);", "takes no part"),
]


@pytest.mark.parametrize("index", range(len(UNDEFINED_OPERATIONS)))
def test_undefined_behaviour_ends_the_launch(index):
    bodies = "\n".join(f"if (which == {n}) {{ {body} }}" for n, (body, _) in enumerate(UNDEFINED_OPERATIONS))
    kernel = KernelSource('extern "C" __global__ void kernel(int which) {' + bodies + "}")
    for order, seed in cuda_emulator.ORDERS:
        with pytest.raises(
            cuda_emulator.EmulationError, match=f"kernel: block [0-9]+: .*({UNDEFINED_OPERATIONS[index][1]})"
        ):
            run(kernel, ctypes.c_int32(index), blocks=2, order=order, seed=seed)
    run(kernel, ctypes.c_int32(-1))  # a failure does not affect the next launch


def test_arguments_of_other_types_are_refused():
    kernel = KernelSource('extern "C" __global__ void kernel(float* a, const long long* b, int c, float d) {}')
    integers, floats = torch.zeros(3, dtype=torch.int64), torch.zeros(3)
    valid_arguments = (floats, integers, ctypes.c_int32(1), ctypes.c_float(1))
    run(kernel, *valid_arguments)
    run(kernel, None, *valid_arguments[1:])
    for position, invalid_argument in enumerate([integers, integers.int(), ctypes.c_int64(1), ctypes.c_int32(1)]):
        with pytest.raises(AssertionError):
            run(kernel, *valid_arguments[:position], invalid_argument, *valid_arguments[position + 1 :])
    with pytest.raises(AssertionError):
        run(kernel, *valid_arguments[:3])
    with pytest.raises(AssertionError):
        run(kernel, torch.zeros(3, 2).T, *valid_arguments[1:])


def test_a_seed_determines_the_order():
    """Threads write forwards, backwards, or in the order of the seed."""
    kernel = KernelSource(
        """extern "C" __global__ void kernel(int* out, int* next) { out[(*next)++] = threadIdx.x; }"""
    )

    def write_order(name, seed=0):
        out = torch.zeros(64, dtype=torch.int32)
        run(kernel, out, torch.zeros(1, dtype=torch.int32), order=name, seed=seed)
        return out.tolist()

    assert write_order("forward") == [*range(64)] and write_order("reverse") == [*range(63, -1, -1)]
    assert write_order("random", 1) == write_order("random", 1) != write_order("random", 2)
    assert sorted(write_order("random", 1)) == [*range(64)]


SANITIZER_SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
import torch
from test_cuda_emulator import KernelSource, run
out = torch.zeros(64, dtype=torch.int32)
head = 'extern "C" __global__ void kernel(int* out) { __shared__ int a[64]; const int n = threadIdx.x;'
run(KernelSource(head + sys.argv[2] + "}"), out)
print(out.tolist() == [*range(64)])
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "checks, body, error_text",
    [
        ("address,undefined", "a[63 - n] = 63 - n; __syncthreads(); out[n] = a[n];", None),
        ("address", "a[n] = n; __syncthreads(); out[n + 1] = a[n];", "heap-buffer-overflow"),
        ("address", "a[n] = n; __syncthreads(); out[n] = a[n + 1];", "global-buffer-overflow"),
        ("address", "int own[4] = {n}; __syncthreads(); out[n] = own[n % 5];", "stack-buffer-overflow"),
        ("undefined", "out[n] = n << (n + 1);", "left shift of 27"),
    ],
)
def test_sanitizers_detect_memory_errors_of_kernels(checks, body, error_text):
    """On fibers as on ordinary stacks; `make sanitize` runs all kernels with them."""
    libraries = (f"$(g++ -print-file-name={name}.so)" for name in ("libasan", "libstdc++"))
    environment = {
        "EMULATOR_FLAGS": f"-g -fsanitize={checks} -fno-sanitize-recover=all",
        "ASAN_OPTIONS": "detect_leaks=0",
    }
    command = f'LD_PRELOAD="{" ".join(libraries)}" exec "$0" "$@"'
    arguments = [sys.executable, "-c", SANITIZER_SCRIPT, str(Path(__file__).parent), body]
    process = subprocess.run(
        ["sh", "-c", command, *arguments], env=os.environ | environment, capture_output=True, text=True
    )
    if error_text is None:
        assert (process.returncode, process.stdout.strip()) == (0, "True"), process.stderr
    else:
        assert process.returncode and error_text in process.stderr, process.stderr
