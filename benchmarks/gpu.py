"""All that is measured on a GPU, in one command: python benchmarks/gpu.py --folder FOLDER [--minutes 9]

Parts: `city` makes the photographs of `paper`, `tests` runs the tests that need a GPU, `twins` compares images and
gradients of the GPU's kernels with those of the CPU's, `steps` times a training step on both, `paper` trains with the
settings of Gao et al. 2025 and scores held-out views and the centres, and `surface` scores the surface of that model.

FOLDER keeps photographs, checkpoints and results.json: parts that have results of this commit and GPU are not repeated,
and `paper` continues where the minutes of an earlier call ended. `city` needs VTK and no GPU, the other parts need no
VTK: make the city anywhere, and copy the folder. `--emulate` runs all parts small and without a GPU, with its kernels
emulated: only to show that they run.
"""

from __future__ import annotations

import argparse
import json
import platform
import shutil
import statistics
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from measure import alternate, commit, setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from splat_cities import EXTENT, City, read_city, score_cloud
from splat_contestants import Ours, make_picture
from splat_passes import Engine, random_image_gradients, run_pass
from splat_scenes import SCENES, make_scene, scattered_cloud

from pcbench.geometry.cloud import Cloud
from pcbench.measure.images import psnr, ssim
from pcbench.scenes import read_scene
from pcbench.scenes.splits import split_every
from pcbench.scenes.write import write_cameras
from pcbench.scratch import atomic_write
from reconstructors.mvs.views import view_stage
from reconstructors.splat import cpu, extract
from reconstructors.splat.model import LocalFrame
from reconstructors.splat.photographs import Photograph, read_photographs
from reconstructors.splat.recipes import RECIPES
from reconstructors.splat.resume import load_model, save_model
from reconstructors.splat.splat import initial_model
from reconstructors.splat.train import Training, evaluate, render

PARTS = ("city", "tests", "twins", "steps", "paper", "surface")
LIBRARIES = ("pcbench", "torch", "numpy", "scipy", "cuda-core", "cuda-bindings", "nvidia-cuda-nvrtc")
JPEG_QUALITY = 80  # 90 kB per photograph of 960 x 540
START_NOISE = 2.0  # standard deviation of the initial points, in pixel footprints
CHECKPOINT_INTERVAL_S = 60.0
MODEL = "model.pt"
LARGE = 100_000, 480, 270  # Gaussians, width, height of the largest twin


class Plan(NamedTuple):
    """Sizes of the parts: in full, or for an emulated GPU."""

    images: int
    image_size: str
    steps: int
    start_points: int
    max_gaussians: int
    round: int  # steps between two looks at the clock
    curve_interval: int  # steps between two rows of PSNR and number of Gaussians
    pictures: tuple[tuple[int, int, int], ...]  # width, height, Gaussians
    runs: int


_PICTURES = ((480, 270, 50_000), (960, 540, 200_000), (1920, 1080, 1_000_000))
_SMALL_PICTURES = ((32, 24, 100), (48, 32, 200), (64, 48, 400))
FULL = Plan(400, "960x540", 30_000, 20_000, 2_000_000, 100, 2000, _PICTURES, 9)
SMALL = Plan(16, "96x64", 40, 500, 1000, 10, 20, _SMALL_PICTURES, 2)


class Machine(NamedTuple):
    """The kernels to be measured, and the device of their tensors; an emulated GPU has those of the CPU."""

    kernels: Any
    device: torch.device
    name: str

    @property
    def is_gpu(self) -> bool:
        """Return whether this is a real GPU."""
        return self.device.type == "cuda"

    def wait(self) -> None:
        """Wait until all work of the GPU has been done."""
        if self.is_gpu:
            torch.cuda.synchronize()


class OutOfTime(Exception):
    """The minutes are used up; the message tells how far the part is."""


class Clock:
    """The time that is left of a number of minutes."""

    def __init__(self, minutes: float) -> None:
        self._end = time.monotonic() + 60 * minutes

    @property
    def is_over(self) -> bool:
        """Return whether no time is left."""
        return time.monotonic() > self._end


def make_city(folder: Path, plan: Plan) -> dict[str, Any]:
    """Make the city with its photographs as JPEG, in a folder that can be copied."""
    made = folder / "made"
    shutil.rmtree(made, ignore_errors=True)
    arguments = ["synth", "city", "--out", made, "--extent", EXTENT, "--points", 200_000, "--seed", 11, "--quiet"]
    arguments += ["--images", plan.images, "--size", plan.image_size]
    subprocess.run([sys.executable, "-m", "pcbench.cli", *map(str, arguments)], check=True)
    from PIL import Image

    city = folder / "city"
    shutil.rmtree(city, ignore_errors=True)
    (city / "images").mkdir(parents=True)
    scene, cameras = read_scene(made), {}
    for name, camera in scene.cameras.items():
        jpeg = Path(name).with_suffix(".jpg").name
        Image.open(scene.folder / name).save(city / "images" / jpeg, quality=JPEG_QUALITY)
        cameras[jpeg] = replace(camera, name=jpeg)
    write_cameras(city / "transforms.json", cameras, city / "images")
    (city / "truth").mkdir()
    for name in ("cloud.ply", "mesh.ply"):
        (made / "truth" / name).rename(city / "truth" / name)
    shutil.rmtree(made)
    size = sum(file.stat().st_size for file in city.rglob("*") if file.is_file())
    return {"images": plan.images, "size": plan.image_size, "jpeg_quality": JPEG_QUALITY, "bytes": size}


def run_tests(folder: Path) -> dict[str, Any]:
    """Run the tests that need a GPU, and return how many passed, failed and were skipped."""
    report = folder / "tests.xml"
    command = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", "tests/reconstructors/splat", f"--junitxml={report}"]
    subprocess.run(command, cwd=Path(__file__).parents[1], check=False)
    suite = next(ET.parse(report).iter("testsuite"))
    counts = {name: int(suite.get(name, 0)) for name in ("tests", "failures", "errors", "skipped")}
    failed = [
        f"{case.get('classname')}::{case.get('name')}"
        for case in suite.iter("testcase")
        if case.find("failure") is not None or case.find("error") is not None
    ]
    return {**counts, "passed": counts.pop("tests") - sum(counts.values()), "failed": failed}


def compare_twins(machine: Machine, *, large: bool) -> list[dict[str, Any]]:
    """Return the largest differences of images and gradients between the GPU's kernels and the CPU's, by scene."""
    scenes = {kind.__name__: make_scene(kind) for kind in SCENES}
    if large:
        count, width, height = LARGE
        scenes["large"] = scattered_cloud(np.random.default_rng(11), count, width, height, size=0.012)
    rows = []
    for name, scene in scenes.items():
        image_gradients = random_image_gradients(scene)
        ours, theirs = (
            run_pass(engine, scene, image_gradients)
            for engine in (Engine(machine.kernels, machine.device.type), Engine(cpu, "cpu"))
        )
        row = {"scene": name, "gaussians": len(scene.means)}
        for label, twin, reference in (
            ("image", ours.images, theirs.images),
            ("gradient", ours.gradients, theirs.gradients),
        ):
            row[f"largest_{label}_difference"] = max(_difference(twin[part], reference[part]) for part in reference)
        rows.append(row)
    return rows


def _difference(values: np.ndarray, reference: np.ndarray) -> float:
    """Return the largest difference relative to the largest value of the reference."""
    if not reference.size:
        return 0.0
    return float(np.abs(values - reference).max() / max(np.abs(reference).max(), np.finfo(np.float32).tiny))


def time_steps(machine: Machine, plan: Plan) -> list[dict[str, Any]]:
    """Return median milliseconds of a training step by size, on the GPU and on the CPU in alternating runs."""
    rows = []
    for width, height, count in plan.pictures:
        on_gpu = Ours(make_picture(count, width, height, machine.device.type))
        on_gpu._kernels, on_gpu.rasterizer = machine.kernels, machine.kernels.Rasterizer()
        on_cpu = Ours(make_picture(count, width, height))

        def step(contestant: Ours) -> Callable[[], None]:
            def run() -> None:
                for part in (contestant.forward, contestant.loss, contestant.backward, contestant.adam):
                    part()
                machine.wait()

            run()  # compiles, and allocates buffers
            return run

        seconds = alternate({"gpu": step(on_gpu), "cpu": step(on_cpu)}, plan.runs)
        difference = _difference(on_gpu.image.cpu().numpy(), on_cpu.image.numpy())
        milliseconds = {f"{name}_ms": round(1e3 * value.wall, 3) for name, value in seconds.items()}
        size = {"width": width, "height": height, "gaussians": count}
        rows.append({**size, **milliseconds, "largest_image_difference": difference})
    return rows


def train(folder: Path, machine: Machine, plan: Plan, clock: Clock, code: str) -> dict[str, Any]:
    """Train with the recipe of Gao et al. 2025 on the city, or continue; score held-out views and the centres.

    Training starts at points of the true surface with noise, in place of the sparse points of structure from motion.
    Each eighth image is held out.

    Args:
        folder: folder of the city, of the checkpoint and of the model.
        machine: the device.
        plan: sizes.
        clock: time that is left; a training that it ends continues in the next call.
        code: commit; the training of another one is not continued.
    """
    city = read_city(folder / "city")
    cameras, work = city.scene.cameras, folder / "work"
    work.mkdir(exist_ok=True)
    folders = {name: view_stage(city.scene, camera, camera, work) for name, camera in cameras.items()}
    frame, split = LocalFrame.of(list(cameras.values())), split_every(list(cameras))
    pyramids = read_photographs(folders, cameras, frame, 1, machine.device)
    training = _new_training(city, frame, [p for p in pyramids if p[0].name in split.train], machine, plan)
    held_out = [pyramid[0] for pyramid in pyramids if pyramid[0].name in split.test]
    checkpoint, progress, key = folder / "paper.pt", folder / "paper.json", f"{code} {machine.name} {plan}"
    seconds, curve = 0.0, []
    if checkpoint.is_file() and progress.is_file() and training.load(checkpoint, key):
        state = json.loads(progress.read_text())
        seconds, curve = state["seconds"], [row for row in state["curve"] if row["step"] <= training.step]
    saved = time.monotonic()
    while training.step < plan.steps:
        start = time.perf_counter()
        training.run(min(plan.steps, training.step + plan.round))
        machine.wait()
        seconds += time.perf_counter() - start
        if training.step % plan.curve_interval == 0 or training.step == plan.steps:
            psnr_db = statistics.fmean(score.psnr for score in evaluate(training.model, held_out))
            curve.append({"step": training.step, "seconds": seconds, "gaussians": len(training.model), "psnr": psnr_db})
            print("  " + _text(curve[-1]), flush=True)
        is_late = clock.is_over
        if is_late or training.step == plan.steps or time.monotonic() - saved > CHECKPOINT_INTERVAL_S:
            training.save(checkpoint, key)
            _write_json(progress, {"seconds": seconds, "curve": curve})
            saved = time.monotonic()
        if is_late and training.step < plan.steps:
            raise OutOfTime(f"step {training.step:,} of {plan.steps:,}")
    save_model(folder / MODEL, training.model)
    return {
        "training_seconds": seconds,
        "peak_gpu_bytes": torch.cuda.max_memory_allocated() if machine.is_gpu else None,
        "held_out_views": _score_views(training, held_out),
        "centres": _score(city, extract.means(training.model, frame)),
        "curve": curve,
    }


def score_surface(folder: Path, machine: Machine) -> dict[str, float]:
    """Score the surface of the trained model."""
    city, model = read_city(folder / "city"), load_model(folder / MODEL, machine.device)
    cameras = city.scene.cameras
    return _score(city, extract.surface(model, LocalFrame.of(list(cameras.values())), cameras))


def _new_training(
    city: City, frame: LocalFrame, pyramids: list[list[Photograph]], machine: Machine, plan: Plan
) -> Training:
    recipe, rng = RECIPES["gao2025"], np.random.default_rng(0)
    rows = rng.choice(len(city.truth.cloud), plan.start_points, replace=False)
    start = city.truth.cloud.select(rows)
    noise = START_NOISE * city.truth.pixel * rng.normal(size=start.points.shape)
    model = initial_model(Cloud(start.points + noise, colors=start.colors), frame, plan.start_points, 0)
    schedule = replace(recipe.schedule, steps=plan.steps, sh_degree=recipe.sh_degree, seed=0)
    density = replace(recipe.densification, max_gaussians=plan.max_gaussians)
    return Training(model.to(machine.device), pyramids, schedule, density)


def _score_views(training: Training, held_out: list[Photograph]) -> dict[str, float]:
    """Return mean scores of the held-out views."""
    pairs = [(render(training.model, p.view).cpu().numpy(), p.color.cpu().numpy()) for p in held_out]
    pairs = [((255 * image).round().astype(np.uint8), photograph) for image, photograph in pairs]
    return {metric.__name__: float(np.mean([metric(*pair) for pair in pairs])) for metric in (psnr, ssim)}


def _score(city: City, cloud: Cloud) -> dict[str, float]:
    score = score_cloud(city.truth, cloud.points)
    return {**score._asdict(), "fscore": score.fscore, "fscore_seen": score.fscore_seen, "pixel_m": city.truth.pixel}


def find_machine(*, emulate: bool) -> Machine | None:
    """Return the GPU with the kernels for it, or the emulated ones on the CPU; None without a GPU."""
    if emulate:
        from cuda_emulator import EmulatedCuda

        return Machine(EmulatedCuda(), torch.device("cpu"), "emulated")
    if not torch.cuda.is_available():
        return None
    from reconstructors.splat import cuda

    return Machine(cuda, torch.device("cuda"), torch.cuda.get_device_name())


def describe(machine: Machine | None, code: str) -> dict[str, Any]:
    """Return commit, machine and versions."""
    versions = {"python": platform.python_version(), "cuda of torch": torch.version.cuda}
    for library in LIBRARIES:
        try:
            versions[library] = version(library)
        except PackageNotFoundError:
            versions[library] = None
    return {"commit": code, "machine": setting(), "gpu": machine and machine.name, "versions": versions}


def _is_current(part: str, entry: dict[str, Any], about: dict[str, Any], plan: Plan) -> bool:
    """Return whether a result is of this code and GPU; the city is the same for all, but not for all plans."""
    if part == "city":
        return entry["result"]["images"] == plan.images
    return (entry["commit"], entry["gpu"]) == (about["commit"], about["gpu"])


def print_tables(results: Mapping[str, Any]) -> None:
    """Print what was measured."""
    for part, entry in results.items():
        rows = entry["result"] if isinstance(entry["result"], list) else [entry["result"]]
        print(f"\n{part}: {entry['commit']}, {entry['gpu'] or 'no GPU'}, {entry['seconds']:.0f} s")
        for row in rows:
            print("  " + ", ".join(f"{name} {_text(value)}" for name, value in row.items()))


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return "(" + ", ".join(f"{name} {_text(part)}" for name, part in value.items()) + ")"
    if isinstance(value, list):
        return f"{_text(value[-1])} (last of {len(value)})" if value else "none"
    return f"{value:.4g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)


def _write_json(path: Path, document: Any) -> None:
    with atomic_write(path) as file:
        file.write((json.dumps(document, indent=1) + "\n").encode())


def main() -> int:
    """Run the parts that have no results yet, as far as the minutes suffice."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="folder for photographs, checkpoints and results")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to run")
    parser.add_argument("--minutes", type=float, default=60.0, help="time after which no more work is begun")
    parser.add_argument("--commit", default=commit(), help="name of the code, where git does not know it")
    parser.add_argument("--emulate", action="store_true", help="run small, with emulated kernels, without a GPU")
    options = parser.parse_args()
    machine, clock = find_machine(emulate=options.emulate), Clock(options.minutes)
    if machine is None and set(options.only) != {"city"}:
        print("no GPU: torch finds no CUDA device; --emulate runs all parts small on the CPU", file=sys.stderr)
        return 2
    plan, about = SMALL if options.emulate else FULL, describe(machine, options.commit)
    options.folder.mkdir(parents=True, exist_ok=True)
    file = options.folder / "results.json"
    results: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {}
    functions: dict[str, Callable[[], Any]] = {
        "city": lambda: make_city(options.folder, plan),
        "tests": lambda: run_tests(options.folder),
        "twins": lambda: compare_twins(machine, large=machine.is_gpu),
        "steps": lambda: time_steps(machine, plan),
        "paper": lambda: train(options.folder, machine, plan, clock, options.commit),
        "surface": lambda: score_surface(options.folder, machine),
    }
    late = None
    for part in (part for part in PARTS if part in options.only):
        if part in results and _is_current(part, results[part], about, plan):
            continue
        start = time.monotonic()
        print(f"{part} ...", flush=True)
        try:
            if clock.is_over:
                raise OutOfTime("not begun")
            result = functions[part]()
        except OutOfTime as error:
            late = f"{part}: {error}"
            break
        results[part] = {**about, "seconds": round(time.monotonic() - start, 1), "result": result}
        _write_json(file, results)
    print_tables(results)
    if late:
        print(f"\nout of time in {late}; the same command continues")
    return 0


if __name__ == "__main__":
    sys.exit(main())
