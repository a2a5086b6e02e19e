"""Milliseconds of a training step on one picture: python benchmarks/splat_raster.py

Times rendering, the loss, its gradients with respect to the Gaussians, the optimizer's step, and the complete step, by
image size, number of Gaussians, threads and instruction set. Peers are plain torch, OpenSplat's CPU rasterizer if
`--opensplat` names the folder of its source (compiled when needed; needs a C++ compiler and ninja), and gsplat on a GPU
(`--device cuda`).
"""

import argparse
import gc
import importlib.util
import itertools
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from measure import Seconds, limit_threads, setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

PARTS = ("forward", "loss", "backward", "adam")
MODEL_BYTES = 3 * 4 * (3 + 4 + 3 + 1 + 48)  # per Gaussian: its parameters, and two moments of each in the optimizer
MAX_TORCH_PIXELS = 3e7  # pixels of tiles times Gaussians in them; above, plain torch needs gigabytes


def step(contestant: Any, wait: Any) -> list[Seconds]:
    """Return wall and CPU seconds of each part."""
    parts = []
    gc.collect()
    for part in PARTS:
        wall, cpu = time.perf_counter(), time.process_time()
        getattr(contestant, part)()
        wait()
        parts.append(Seconds(time.perf_counter() - wall, time.process_time() - cpu))
    return parts


def measure(options: dict[str, Any]) -> None:
    """Print the results as JSON, in the child process."""
    if options["device"] == "cpu":
        limit_threads(options["threads"])
    import torch
    from splat_contestants import Gsplat, OpenSplat, Ours, PlainTorch, build_opensplat, contributors, make_picture

    width, height = map(int, options["size"].split("x"))
    picture = make_picture(options["count"], width, height, options["device"])
    uses_gpu = options["device"] != "cpu"
    contestants: dict[str, Any] = {
        "pcbench": Ours(picture),
        "pcbench, depth": Ours(picture, geometry=True, normals=False),
        "pcbench, geometry": Ours(picture, geometry=True),
    }
    for ours in contestants.values():
        step(ours, lambda: None)
    compiled = getattr(contestants["pcbench"].rasterizer, "_compiled", None)
    instances = compiled.instances if compiled else 0
    if options["peers"]:
        if instances * 256 < MAX_TORCH_PIXELS:
            contestants["plain torch"] = PlainTorch(picture)
        if options["opensplat"] and not uses_gpu:
            contestants["OpenSplat"] = OpenSplat(picture, build_opensplat(Path(options["opensplat"])))
        if uses_gpu and importlib.util.find_spec("gsplat"):
            contestants["gsplat"] = Gsplat(picture)
    wait = torch.cuda.synchronize if uses_gpu else lambda: None
    samples: dict[str, list[list[Seconds]]] = {name: [] for name in contestants}
    for run in range(options["runs"] + 1):  # the first run is a warm-up
        for name, contestant in contestants.items():
            if (parts := step(contestant, wait)) and run:
                samples[name].append(parts)
    image = contestants["pcbench"].image.clamp(max=1)
    results = {
        "drawn": len(contestants["pcbench"].pulled.ids),
        "instances": instances,
        "alpha": 1 - float(contestants["pcbench"].transmittance.mean()),
        "contributors": contributors(picture) if options["first"] else None,
        "bytes": [contestants[name].rasterizer._compiled.bytes for name in ("pcbench", "pcbench, geometry")]
        if compiled
        else [],
        "rows": {
            name: {
                # With a GPU the CPU only launches the work.
                "parts": [
                    statistics.median(parts[i][0 if uses_gpu else 1] for parts in runs) for i in range(len(PARTS))
                ],
                "cpu": [pick(sum(part.cpu for part in parts) for parts in runs) for pick in (statistics.median, min)],
                "wall": [pick(sum(part.wall for part in parts) for parts in runs) for pick in (statistics.median, min)],
                "off": float((contestants[name].image.clamp(max=1) - image).abs().mean()),
            }
            for name, runs in samples.items()
        },
    }
    print(json.dumps(results))


def run_child(options: dict[str, Any], isa: str) -> dict[str, Any]:
    """Measure in a child process, with one instruction set."""
    # Passive waiting: threads that spin while they wait would add CPU time.
    environment = {**os.environ, "OMP_WAIT_POLICY": "passive", **({"PCBENCH_ISA": isa} if isa else {})}
    process = subprocess.run(
        [sys.executable, Path(__file__), "--child", json.dumps(options)],
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return json.loads(process.stdout.splitlines()[-1])


def describe(results: dict[str, Any], size: str, count: int) -> str:
    """Return a line on the picture and the memory."""
    buffers = " and ".join(f"{bytes_ / count:.0f}" for bytes_ in results["bytes"])
    tiles = f", {results['instances']:,} tile instances" if results["instances"] else ""
    memory = f"; bytes per Gaussian: {MODEL_BYTES} of model and moments, {buffers} of buffers" if buffers else ""
    return (
        f"{size}, {count:,} Gaussians: {results['drawn']:,} rendered{tiles}, {results['contributors']:.0f} per pixel, "
        f"alpha {results['alpha']:.2f}{memory}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="480x270")
    parser.add_argument("--counts", default="50000")
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--isas", default="", help="such as baseline,avx2,avx512; default: the widest available")
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--no-peers", action="store_true", help="pcbench alone")
    parser.add_argument("--opensplat", metavar="FOLDER", help="folder with the source of OpenSplat")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        return measure(json.loads(options.child))
    clock = "CPU" if options.device == "cpu" else "wall"
    print(f"{setting()}; {options.device}; medians of {options.runs} alternating runs")
    print(f"milliseconds: {clock} time for parts and ratio; CPU and wall time for the complete step, median and least")
    head = "".join(f"{name:>9}" for name in (*PARTS, "CPU", "least", "wall", "least", "ratio"))
    print(f"{'threads':>7} {'loops':10}{'method':18}{head}{'image off':>11}")
    isas, thread_counts = options.isas.split(","), [int(number) for number in options.threads.split(",")]
    for size, count in itertools.product(options.sizes.split(","), map(int, options.counts.split(","))):
        for number, (isa, threads) in enumerate(itertools.product(isas, thread_counts)):
            child = {"size": size, "count": count, "threads": threads, "runs": options.runs, "device": options.device}
            child["first"] = number == 0
            peers = {"peers": not options.no_peers and isa == isas[0], "opensplat": options.opensplat}
            results = run_child(child | peers, isa)
            if number == 0:
                print("\n" + describe(results, size, count))
            pcbench_row = results["rows"]["pcbench"]
            for name, row in results["rows"].items():
                times = (*row["parts"], *row["cpu"], *row["wall"])
                ratio = sum(row["parts"]) / sum(pcbench_row["parts"])
                print(
                    f"{threads:7} {isa or 'widest':10}{name:18}{''.join(f'{1e3 * seconds:9.1f}' for seconds in times)}"
                    f"{ratio:9.1f}{row['off']:11.1e}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
