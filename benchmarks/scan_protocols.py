"""Evaluations of ETH3D and Tanks and Temples by pcbench, beside the official programs.

    python benchmarks/scan_protocols.py [--data PCBENCH_DATA/protocols] [--program ETH3DMultiViewEvaluation]
        [--scan-points 4500000] [--points 2000000] [--runs 1]

--data         folder with eth3d/, tnt/ and expected.json, with scores that the official programs printed; left out if
               it is absent
--program      the official program of ETH3D, run with its own options beside pcbench; left out if it is not given
--scan-points  points of each of the two scans of a made room; 0: no room
--points       points of its candidate
--runs         alternating runs, of which the median counts

ETH3D: scores are compared to six digits, as the program prints them. Tanks and Temples: scores at a given pose are
compared to all digits, and poses after the three runs of ICP with those of the same steps in Open3D.
"""

from __future__ import annotations

import argparse
import copy
import json
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measure import setting
from real_data import data_root

from pcbench import Similarity, read_cloud
from pcbench.geometry.polygon_files import read_polygon
from pcbench.geometry.transform import read_matrix, rotation_from_vector
from pcbench.measure.protocols.eth3d import Eth3d
from pcbench.measure.protocols.protocol import EvaluationInputs
from pcbench.measure.protocols.tnt import TanksAndTemples
from pcbench.registration.trajectories import refine_pose

ROOM = np.array([12.0, 9.0, 4.0])  # metres
NAMES = ("completeness", "accuracy", "f1")


class Run(NamedTuple):
    """Scores of ETH3D by name, one per tolerance, and the seconds that they took."""

    scores: dict[str, list[str]]
    wall: float
    cpu: float


def with_pcbench(protocol: Eth3d, project: Path, candidate: Path) -> Run:
    """Evaluate with pcbench."""
    wall, cpu = time.perf_counter(), time.process_time()
    evaluation = protocol.evaluate(EvaluationInputs(project, candidate))
    seconds = time.perf_counter() - wall, time.process_time() - cpu
    scores = {name: [f"{s.value:.6g}" for s in evaluation.scores if s.name.startswith(f"{name}@")] for name in NAMES}
    return Run(scores, *seconds)


def with_program(program: Path, protocol: Eth3d, project: Path, candidate: Path) -> Run:
    """Evaluate with the official program; its CPU time is that of the child process."""
    from os import times

    command = [
        *(str(program), "--ground_truth_mlp_path", str(project), "--reconstruction_ply_path", str(candidate)),
        *("--tolerances", ",".join(map(str, protocol.tolerances)), "--voxel_size", str(protocol.voxel_size)),
        *("--beam_start_radius_meters", str(protocol.beam_start_radius)),
        *("--beam_divergence_halfangle_deg", str(protocol.beam_divergence_halfangle_deg)),
    ]
    before, wall = times(), time.perf_counter()
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    after, seconds = times(), time.perf_counter() - wall
    titles = {"Completenesses": "completeness", "Accuracies": "accuracy", "F1-scores": "f1"}
    printed = dict(line.split(": ", 1) for line in lines if line.split(":")[0] in titles)
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return Run({titles[title]: words.split() for title, words in printed.items()}, seconds, cpu)


def print_eth3d(
    title: str,
    protocol: Eth3d,
    project: Path,
    candidate: Path,
    program: Path | None,
    runs: int,
    expected: dict[str, Any] | None,
) -> None:
    """Print the scores and times of each side for one case."""
    sides: dict[str, list[Run]] = {"pcbench": [], "official": []}
    for _ in range(runs):
        sides["pcbench"].append(with_pcbench(protocol, project, candidate))
        if program is not None:
            sides["official"].append(with_program(program, protocol, project, candidate))
    official = None if expected is None else {name: [f"{value:.6g}" for value in expected[name]] for name in NAMES}
    if official is None and program is not None:
        official = sides["official"][0].scores
    print(f"\nETH3D: {title}")
    for name in NAMES:
        ours = sides["pcbench"][0].scores[name]
        verdict = "" if official is None else " (all digits equal)" if ours == official[name] else " (DIFFERENT)"
        print(f"{name:14}{' '.join(ours)}{verdict}")
    for side, done in sides.items():
        if done:
            wall, cpu = (float(np.median([getattr(run, kind) for run in done])) for kind in ("wall", "cpu"))
            print(f"{side:14}{wall:.1f} s wall, {cpu:.1f} s CPU")


def make_room(folder: Path, scan_points: int, points: int) -> tuple[Path, Path]:
    """Write two scans of a room with noise of 1 mm, their project, and a candidate with noise of 1 cm.

    A tenth of the candidate's points are in the empty room.
    """
    rng, meshes = np.random.default_rng(0), []

    def seen_from(eye: np.ndarray, directions: np.ndarray) -> np.ndarray:
        depths = np.where(directions > 0, (ROOM - eye) / directions, -eye / directions).min(axis=1)
        return eye + directions * depths[:, None]

    for number, (eye, angle) in enumerate((((3.0, 3.0, 1.5), 0.3), ((9.0, 6.0, 1.6), -1.2))):
        rows = round(np.sqrt(scan_points / 2))
        inclinations, azimuths = np.meshgrid(
            (np.arange(rows) + 0.5) / rows * np.pi, (np.arange(2 * rows) + 0.5) / rows * np.pi
        )
        rays = np.stack(
            [
                np.sin(inclinations) * np.cos(azimuths),
                np.sin(inclinations) * np.sin(azimuths),
                np.cos(inclinations),
            ],
            axis=-1,
        ).reshape(-1, 3)
        scan = seen_from(np.array(eye), rays) - eye
        lengths = np.linalg.norm(scan, axis=1, keepdims=True)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation_from_vector(np.array([0.0, 0.0, angle])), eye
        _write(folder / f"scan{number}.ply", scan * (1 + rng.normal(0, 0.001, lengths.shape) / lengths) @ pose[:3, :3])
        matrix = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in pose)
        meshes.append(f'<MLMesh filename="scan{number}.ply"><MLMatrix44>\n{matrix}\n</MLMatrix44></MLMesh>')
    project = folder / "scan_alignment.mlp"
    project.write_text(f"<MeshLabProject><MeshGroup>{''.join(meshes)}</MeshGroup></MeshLabProject>")
    directions = rng.normal(size=(points, 3))
    candidate = seen_from(ROOM / 2, directions) + rng.normal(0, 0.01, directions.shape)
    candidate[: points // 10] = rng.uniform(0.5, 3.5, (points // 10, 3))
    _write(folder / "candidate.ply", candidate)
    return project, folder / "candidate.ply"


def _write(path: Path, points: np.ndarray) -> None:
    """Write points as float32, the only type that the official program reads."""
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_bytes(header.encode() + points.astype("<f4").tobytes())


def print_tnt(folder: Path, expected: dict[str, dict[str, float]]) -> None:
    """Print scores beside the official ones, and the refinement of a pose beside that with Open3D."""
    truth, volume = read_matrix(folder / "alignment.txt"), read_polygon(folder / "crop.json")
    reference, candidate = folder / "gt.ply", folder / "reconstruction.ply"
    for threshold, scores in expected.items():
        if threshold != "made_with":
            inputs = EvaluationInputs(reference, candidate, pose=truth, crop=volume)
            start = time.process_time()
            ours = {s.name.split("@")[0]: s.value for s in TanksAndTemples(float(threshold)).evaluate(inputs).scores}
            seconds, equal = time.process_time() - start, all(ours[name] == value for name, value in scores.items())
            verdict = "all digits equal" if equal else "DIFFERENT"
            print(f"\nTanks and Temples at {threshold}: {verdict}, {seconds:.2f} s CPU")
            print(" ".join(f"{name} {value!r}" for name, value in ours.items()))
    bump = Similarity(rotation_from_vector(np.array([0.01, -0.02, 0.015])), np.array([0.03, -0.02, 0.01]), 1.01)
    start_pose, clouds = bump @ truth, [read_cloud(path).points for path in (reference, candidate)]
    for threshold in (0.01, 0.02):
        begin = time.process_time()
        refined = refine_pose(start_pose, clouds[0], clouds[1], threshold, volume)
        middle = time.process_time()
        theirs = refine_with_open3d(start_pose.matrix, clouds, threshold, folder / "crop.json")
        end = time.process_time()
        print(
            f"\nICP at threshold {threshold}: largest difference of the 4x4 matrices"
            f" {np.abs(refined.pose.matrix - theirs).max():.1e}; pcbench {middle - begin:.1f} s CPU,"
            f" Open3D {end - middle:.1f} s CPU"
        )


def refine_with_open3d(pose: np.ndarray, clouds: list[np.ndarray], threshold: float, volume_file: Path) -> np.ndarray:
    """Return the pose (4, 4) after the three runs of ICP as the official program calls Open3D."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    volume = o3d.visualization.read_selection_polygon_volume(str(volume_file))
    target, source = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(each))) for each in clouds)
    for voxel, distance in ((threshold, 80 * threshold), (threshold / 2, 20 * threshold), (None, 2 * threshold)):
        parts = [volume.crop_point_cloud(part) for part in (copy.deepcopy(source).transform(pose), target)]
        parts = [part.voxel_down_sample(voxel) if voxel else part for part in parts]
        fit = registration.registration_icp(
            *parts,
            distance,
            np.eye(4),
            registration.TransformationEstimationPointToPoint(True),
            registration.ICPConvergenceCriteria(1e-6, 20),
        )
        pose = fit.transformation @ pose
    return pose


def main() -> None:
    """Print all cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=(data_root() or Path()) / "protocols")
    parser.add_argument("--program", type=Path)
    parser.add_argument("--scan-points", type=lambda text: int(float(text)), default=4_500_000)
    parser.add_argument("--points", type=lambda text: int(float(text)), default=2_000_000)
    parser.add_argument("--runs", type=int, default=1)
    given = parser.parse_args()
    print(setting())
    if (given.data / "expected.json").is_file():
        expected = json.loads((given.data / "expected.json").read_text())
        for case in expected["eth3d"]["cases"]:
            beam = case["beam_start_radius_m"], case["beam_divergence_halfangle_deg"]
            protocol = Eth3d(tuple(expected["eth3d"]["tolerances"]), case["voxel_size"], *beam)
            files = given.data / "eth3d" / "scan_alignment.mlp", given.data / "eth3d" / "reconstruction.ply"
            title = f"beam of {beam[0]:g} m and {beam[1]:g} degrees"
            print_eth3d(title, protocol, *files, given.program, given.runs, case)
        print_tnt(given.data / "tnt", expected["tnt"])
    else:
        print(f"missing: the folder {given.data} of official scores")
    if given.scan_points:
        with tempfile.TemporaryDirectory() as folder:
            files = make_room(Path(folder), given.scan_points, given.points)
            title = f"made room, 2 scans of {given.scan_points:,} points, candidate of {given.points:,}"
            print_eth3d(title, Eth3d(), *files, given.program, given.runs, None)


if __name__ == "__main__":
    main()
