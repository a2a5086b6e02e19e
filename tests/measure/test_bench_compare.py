"""The bench of a whole comparison runs, keeps its limits, and assigns all time to its steps."""

import math
import os
import shutil
import subprocess
import sys

import numpy as np
import oracles
import pytest
from optional import import_or_skip
from repository import ROOT
from wording import check_text

from pcbench import Cloud, read_cloud, write_cloud

BENCH = ROOT / "benchmarks"
SIDE_RUN = {"steps": {"total": [2.0, 3.0], "import": [0.5, 0.5]}, "peak": 2**20}


@pytest.fixture
def sides(monkeypatch):
    monkeypatch.syspath_prepend(BENCH)
    import compare_sides

    return compare_sides


@pytest.fixture
def scaling(sides):
    import compare_scaling

    return compare_scaling


@pytest.fixture
def folder(tmp_path):
    """Two clouds of a city, without noise and displaced by 0.1 m."""
    rng = np.random.default_rng(3)
    import clouds

    points = clouds.uniform_city(rng, 4000)
    write_cloud(tmp_path / "reference.ply", Cloud(points))
    write_cloud(tmp_path / "candidate.ply", Cloud(points[::2] + [0.1, 0, 0]))
    return tmp_path


def test_clock_adds_steps_of_one_name(sides):
    clock = sides.Clock(iter((0.0, 1.0, 3.0, 7.0)).__next__)
    for name in ("read", "search", "read"):
        clock.step(name)
    steps = sides.with_total(clock.steps)
    assert {name: cpu for name, (_, cpu) in steps.items()} == {"read": 5.0, "search": 2.0, "total": 7.0}


def test_steps_and_stages_of_pcbench_contain_all_time(sides, folder):
    result = sides.run_side("ours", folder)
    steps = result["steps"]
    assert set(steps) == set(sides.STEPS)
    for i in range(2):  # wall and CPU seconds; sums are rounded
        compared = steps["total"][i] - steps["import"][i] - steps["read"][i]
        assert sum(seconds[i] for seconds in result["stages"].values()) == pytest.approx(compared, rel=1e-9)
    assert "deformation" in result["timings_s"]["candidate"]
    assert set(result["values"]["candidate"]) == set(sides.METRICS)


def test_limits_and_failures_are_reasons(sides, folder):
    assert sides.run_side("ours", folder, limit_s=0.01) == "> 0.01 s"
    assert sides.run_side("ours", folder, limit_bytes=2**20) == "> 0.000977 GiB"
    (folder / "reference.ply").unlink()
    assert sides.run_side("ours", folder).startswith("failed: ")


def test_missing_peers_are_named(sides, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    missing = sides.missing_sides()
    assert list(missing) == ["open3d", "cloudcompare"]
    check_text("\n".join(missing.values()))


def test_lines_of_cloudcompare_separate_its_steps(sides, monkeypatch, tmp_path):
    lines = ("[Plugin] found", "[LOADING]", "[LOADING]", "[ICP]", "RMS: 1", "[DISTANCE COMPUTATION]", "[SAVING]")
    program = tmp_path / "CloudCompare"
    program.write_text("#!/bin/sh\n" + "".join(f"echo '{line}'\n" for line in lines) + "exit ${FAKE_CODE:-0}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    finished = sides.Finished()
    finished.run(tmp_path, ["-O", tmp_path / "a.ply"])
    finished.run(tmp_path, [])
    assert list(finished.steps) == ["import", "read", "registration", "distances, metrics"]
    assert all(wall >= 0 and cpu >= 0 for wall, cpu in finished.steps.values())
    monkeypatch.setenv("FAKE_CODE", "3")
    with pytest.raises(SystemExit) as stopped:
        finished.run(tmp_path, [])
    check_text(stopped.value)


@pytest.mark.long
@pytest.mark.skipif(shutil.which("CloudCompare") is None, reason="CloudCompare is not installed")
def test_distances_of_cloudcompare_are_those_of_its_pose(sides, folder):
    values = sides.run_side("cloudcompare", folder)["values"]["candidate"]
    reference, candidate = (read_cloud(folder / f"{name}.ply").points for name in ("reference", "candidate"))
    T = np.array(values["T"])
    aligned = candidate @ T[:3, :3].T + T[:3, 3]
    c2r, r2c = (oracles.nearest(a, b)[0] for a, b in ((aligned, reference), (reference, aligned)))
    # Coordinates up to 500 m in float32 are rounded by up to 3e-5 m; the matrix has twelve decimals.
    assert values["d1"] == pytest.approx(np.mean(c2r**2), abs=1e-4 * max(1, c2r.max()))
    assert values["hausdorff"] == pytest.approx(max(c2r.max(), r2c.max()), abs=2e-4)
    assert "d2" not in values


def test_exponent_is_that_of_a_power_law(scaling):
    rows = [scaling.Row("ours", n, cpu=3e-6 * n**1.25) for n in (100_000, 300_000, 1_000_000)]
    too_small = scaling.Row("ours", 90_000, cpu=100.0)
    stopped = scaling.Row("ours", 3_000_000, reason="> 300 s")
    found, sizes = scaling.exponent([too_small, *rows, stopped])
    assert found == pytest.approx(1.25, abs=1e-12)
    assert sizes == [100_000, 300_000, 1_000_000]
    assert scaling.exponent([rows[0], stopped]) is None


@pytest.mark.long
def test_scaling_names_what_stopped_a_side(scaling, monkeypatch, capsys, tmp_path):
    def run(side, folder, **limits):
        size = len(read_cloud(folder / "reference.ply"))
        if side == "open3d" and size == 2000:
            return "> 300 s"
        return {**SIDE_RUN, "steps": {"total": [size / 1000 + 1, size / 500 + 1], "import": [1.0, 1.0]}}

    monkeypatch.setattr(scaling, "run_side", run)
    rows = scaling.measure(["ours", "open3d"], [1000, 2000, 4000], 1, 300.0, 8.0)
    scaling.print_exponents(rows)
    check_text(capsys.readouterr().out)
    scaling.draw(rows, tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 10_000


@pytest.mark.long
def test_whole_bench_runs():
    import_or_skip("open3d")
    command = [sys.executable, BENCH / "compare.py", "--points", "20000", "--runs", "1"]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    for name in ("peak memory, MiB", "testing for deformation", "densified d2", "Open3D", "verdict on deformation"):
        assert name in output
    assert math.isfinite(float(next(line for line in output.splitlines() if line.startswith("total")).split()[1]))
