"""CPU seconds and accuracy of a depth map, against OpenCV's plane sweep on the same images: python benchmarks/mvs.py

The images are photographs of a synthetic city with true cameras and exact depths. `--scaling` varies sources and
threads; `--memory` runs the complete reconstructor on 10 and 50 images and prints its peak memory.
"""

import argparse
import importlib.util
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measure import alternate, limit_threads, setting

PLANE_COUNT = 128
WINDOW_SIDE = 9  # side of a patch in pixels, as in the bundled matcher


class Case(NamedTuple):
    """A reference view with its sources and exact depths."""

    reference: Any
    sources: Sequence[Any]
    depth_range: tuple[float, float]
    truth: np.ndarray
    depths: Sequence[np.ndarray]


def load_case(folder: Path, number: int, count: int) -> Case:
    """Load one image, its sources in the reconstructor's order by angle, and the exact depths of all."""
    from PIL import Image

    from pcbench.scenes import read_scene
    from reconstructors.mvs.patchmatch import GrayView

    scene = read_scene(folder)
    exact_depths = {name: np.load(folder / "truth" / "depth" / f"{Path(name).stem}.npy") for name in scene.images}
    name = scene.images[number]
    reference_camera, truth = scene.cameras[name], exact_depths[name]
    height, width = truth.shape
    depth = truth[height // 2, width // 2]
    target = reference_camera.position + reference_camera.direction * depth

    def angle_deviation(other: str) -> float:
        a, b = reference_camera.position - target, scene.cameras[other].position - target
        cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
        return abs(float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))) - 12)

    others = sorted((other for other in scene.images if other != name), key=angle_deviation)[:count]

    def view(image_name: str) -> GrayView:
        return GrayView(np.asarray(Image.open(scene.folder / image_name).convert("L")), scene.cameras[image_name])

    valid_depths = truth[truth > 0]
    depth_range = (0.9 * float(valid_depths.min()), 1.1 * float(valid_depths.max()))
    return Case(
        view(name), [view(other) for other in others], depth_range, truth, [exact_depths[other] for other in others]
    )


def bundled(case: Case) -> np.ndarray:
    """Run three photometric and two geometric iterations; the sources' depth maps are given."""
    from reconstructors.mvs.patchmatch import match, refine

    matched = match(case.reference, case.sources, case.depth_range)
    return refine(case.reference, case.sources, case.depths, matched, case.depth_range).depth


def photometric(case: Case) -> np.ndarray:
    """Run the photometric iterations alone."""
    from reconstructors.mvs.patchmatch import match

    return match(case.reference, case.sources, case.depth_range).depth


def plane_sweep(case: Case) -> np.ndarray:
    """Sweep fronto-parallel planes at even inverse depths (Collins 1996; Gallup et al. 2007).

    The cost is the mean of the two best sources' normalised correlations over a window. A parabola through the best
    plane and its neighbours refines it.
    """
    import cv2

    gray = case.reference.gray.astype(np.float32)

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values, -1, (WINDOW_SIDE, WINDOW_SIDE))

    reference_mean = mean(gray)
    reference_variance = np.maximum(mean(gray * gray) - reference_mean * reference_mean, 1)
    k = centred(case.reference.camera)
    inverse_depths = np.linspace(1 / case.depth_range[1], 1 / case.depth_range[0], PLANE_COUNT)
    costs = np.empty((PLANE_COUNT, *gray.shape), np.float32)
    for number, inverse_depth in enumerate(inverse_depths):
        source_costs = []
        for source in case.sources:
            relative = source.camera.cam_from_world @ case.reference.camera.cam_from_world.inverse()
            plane = relative.rotation + np.outer(relative.translation, [0, 0, inverse_depth])
            homography = centred(source.camera) @ plane @ np.linalg.inv(k)
            warped = cv2.warpPerspective(
                source.gray, homography, gray.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            ).astype(np.float32)
            warped_mean = mean(warped)
            warped_variance = np.maximum(mean(warped * warped) - warped_mean * warped_mean, 1)
            source_costs.append(
                1 - (mean(gray * warped) - reference_mean * warped_mean) / np.sqrt(reference_variance * warped_variance)
            )
        costs[number] = np.sort(source_costs, axis=0)[:2].mean(axis=0)
    best = np.clip(costs.argmin(axis=0), 1, PLANE_COUNT - 2)
    a, b, c = (np.take_along_axis(costs, (best + d)[None], axis=0)[0] for d in (-1, 0, 1))
    curvature = np.maximum(a - 2 * b + c, 1e-6)
    offset = np.clip(0.5 * (a - c) / curvature, -0.5, 0.5)
    return (1 / (inverse_depths[0] + (best + offset) * (inverse_depths[1] - inverse_depths[0]))).astype(np.float32)


def centred(camera: Any) -> np.ndarray:
    """Return the intrinsics matrix for pixel centres at integers."""
    matrix = camera.intrinsics.matrix
    matrix[:2, 2] -= 0.5
    return matrix


CONTESTANTS: dict[str, Callable[[Case], np.ndarray]] = {"pcbench": bundled, "pcbench, photometric": photometric}
if importlib.util.find_spec("cv2"):
    CONTESTANTS["OpenCV plane sweep"] = plane_sweep


class Accuracy(NamedTuple):
    """Shares of pixels with errors below one, two and five pixel footprints, and the median error in footprints."""

    one: float
    two: float
    five: float
    median: float


def accuracy(case: Case, depth: np.ndarray) -> Accuracy:
    """Evaluate a depth map against the exact depths."""
    has_truth = case.truth > 0
    footprint_errors = np.abs(depth - case.truth)[has_truth] / (
        case.truth[has_truth] / case.reference.camera.intrinsics.fx
    )
    return Accuracy(
        *(float(np.mean(footprint_errors < limit)) for limit in (1, 2, 5)), float(np.median(footprint_errors))
    )


def measure(folder: str, sources: int, threads: int, runs: int) -> None:
    """Print the medians and the accuracies over three images as JSON, in the child process."""
    limit_threads(threads)
    if "OpenCV plane sweep" in CONTESTANTS:
        import cv2

        cv2.setNumThreads(threads)
    from pcbench.scenes import read_scene

    count = len(read_scene(Path(folder)).images)
    rows: dict[str, list[list[float]]] = {name: [] for name in CONTESTANTS}
    for number in (0, count // 3, 2 * count // 3):
        case = load_case(Path(folder), number, sources)
        seconds = alternate({name: partial(run, case) for name, run in CONTESTANTS.items()}, runs)
        for name, run in CONTESTANTS.items():
            rows[name].append([*seconds[name], *accuracy(case, run(case))])
    print(json.dumps({name: np.mean(values, axis=0).tolist() for name, values in rows.items()}))


def create_city(folder: Path, images: int, size: str) -> None:
    """Create the synthetic city."""
    options = ["--images", str(images), "--size", size, "--seed", "3", "--points", "1000", "--quiet"]
    subprocess.run([sys.executable, "-m", "pcbench.cli", "synth", "city", "--out", folder, *options], check=True)


def peak_memory(folder: Path, work: Path) -> float:
    """Return the peak memory of the reconstructor's process, in MiB."""
    script = (
        "import json, resource, subprocess, sys;"
        "command = [sys.executable, '-m', 'pcbench.cli', 'reconstruct', 'mvs', *sys.argv[1:], '--quiet'];"
        "subprocess.run(command, check=True);"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)"
    )
    arguments = [folder, "--out", work / "cloud.ply", "--workspace", work / "workspace"]
    work.mkdir()
    process = subprocess.run([sys.executable, "-c", script, *arguments], check=True, stdout=subprocess.PIPE, text=True)
    return float(process.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="960x540,1920x1080")
    parser.add_argument("--sources", default="4")
    parser.add_argument("--threads", default="1")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--scaling", action="store_true", help="2, 4 and 8 sources, 1 and 2 threads, at 960x540")
    parser.add_argument("--memory", action="store_true", help="peak memory for 10 and for 50 images of 480x270")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        folder, *numbers = options.child
        return measure(folder, *map(int, numbers))
    missing_note = "" if "OpenCV plane sweep" in CONTESTANTS else "; missing: cv2 (pip install opencv-python-headless)"
    print(f"{setting()}; median of {options.runs} alternating runs, mean of three images{missing_note}")
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        if options.memory:
            for images in (10, 50):
                create_city(root / f"{images}", images, "480x270")
                peak = peak_memory(root / f"{images}", root / f"work{images}")
                print(f"{images} images of 480x270: {peak:.0f} MiB at most", flush=True)
            return
        sources, threads, sizes = options.sources, options.threads, options.sizes
        if options.scaling:
            sources, threads, sizes = "2,4,8", "1,2", "480x270,960x540"
        print(f"{'size':>10}{'sources':>8}{'threads':>8}  {'method':22}{'wall s':>8}{'CPU s':>8}{'ratio':>7}", end="")
        print(f"{'< 1 px':>8}{'< 2 px':>8}{'< 5 px':>8}{'median':>8}")
        for size in sizes.split(","):
            create_city(root / size, 12, size)
            for count in sources.split(","):
                for thread_count in threads.split(","):
                    child_arguments = [str(root / size), count, thread_count, str(options.runs)]
                    process = subprocess.run(
                        [sys.executable, Path(__file__), "--child", *child_arguments],
                        check=True,
                        stdout=subprocess.PIPE,
                        text=True,
                    )
                    results = json.loads(process.stdout)
                    for name, (wall, cpu, one, two, five, median) in results.items():
                        ratio = cpu / results["pcbench"][1]
                        print(
                            f"{size:>10}{count:>8}{thread_count:>8}  {name:22}{wall:8.2f}{cpu:8.2f}{ratio:7.2f}"
                            f"{one:8.3f}{two:8.3f}{five:8.3f}{median:8.3f}",
                            flush=True,
                        )


if __name__ == "__main__":
    main()
