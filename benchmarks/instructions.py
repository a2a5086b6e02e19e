"""Instructions of a small comparison, beside those of an earlier commit: python benchmarks/instructions.py

--renew   write the counts and the commit to benchmarks/instructions.json, after the change that explains them
--runs 1  repeat the count; the largest difference is printed

Valgrind counts a comparison of 1,000 with 4,000 points, on one thread with baseline kernels, without start and imports.
Counts do not depend on load, and newer instruction sets are disabled in all libraries. A stage that grows by more than
10 % is printed in capitals. The exit code is 0 in each case, also if the instructions cannot be counted.
"""

import argparse
import ctypes
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from measure import commit

BASELINE = Path(__file__).with_suffix(".json")
REQUESTS = Path(__file__).with_name("callgrind.cpp")
POINTS = 4_000  # of the reference; the candidate has a fourth
GROWTH = 0.10
TIMEOUT_S = 600

# Counts depend on the number of threads, on hash values, and on the instruction sets that libraries find.
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OPENBLAS_CORETYPE": "Nehalem",
    "PYTHONHASHSEED": "0",
    "PCBENCH_ISA": "baseline",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-ERMS",
}
_COST = re.compile(r"[-+*]?\d* (\d+)$")  # a line number, perhaps relative, and its instructions


class Counts(NamedTuple):
    """Instructions per stage of a comparison and per library, and what they depend on."""

    commit: str
    versions: dict[str, str]
    stages: dict[str, int]
    libraries: dict[str, int]


class NotCounted(Exception):
    """The instructions cannot be counted here; the message says why."""


def library(path: str) -> str:
    """Return the group of a shared library in the table."""
    _, is_installed, module = path.rpartition("site-packages/")
    for package, name in (("pcbench/", "compiled core"), ("numpy", "numpy"), ("scipy", "scipy")):
        if is_installed and module.startswith(package):
            return name
    if "/libpython" in path or "/python" in path:
        return "Python"
    return "system libraries"


def read_counts(lines: Iterable[str]) -> tuple[str | None, Counter[str]]:
    """Return the label and the instructions per library of a file that callgrind wrote.

    Calls have the inclusive costs of the function that is called in the line below; those lines are skipped.
    """
    label, names, current = None, {}, ""
    costs: Counter[str] = Counter()
    is_call = False
    for line in lines:
        if match := re.match(r"desc: Trigger: Client Request: (.*)", line):
            label = match[1].strip()
        elif match := re.match(r"c?ob=\((\d+)\)(?: (.*))?", line):
            if match[2]:
                names[match[1]] = match[2].strip()
            if line.startswith("ob="):
                current = library(names[match[1]])
        elif line.startswith("calls="):
            is_call = True
        elif current and (match := _COST.match(line)):
            costs[current] += 0 if is_call else int(match[1])
            is_call = False
    return label, costs


def count() -> Counts:
    """Count the instructions of the comparison.

    Raises:
        NotCounted: valgrind or a compiler is missing, or the count failed.
    """
    valgrind, compiler = shutil.which("valgrind"), shutil.which("c++") or shutil.which("g++")
    if not (valgrind and compiler):
        raise NotCounted("expected valgrind and a C++ compiler (Debian: valgrind, g++)")
    with tempfile.TemporaryDirectory() as folder:
        requests = Path(folder) / "requests.so"
        build = subprocess.run([compiler, "-shared", "-fPIC", "-o", requests, REQUESTS], capture_output=True, text=True)
        if build.returncode:
            raise NotCounted(f"expected valgrind/callgrind.h (Debian: valgrind): {build.stderr.splitlines()[0]}")
        tool = [valgrind, "--tool=callgrind", "--instr-atstart=no", f"--callgrind-out-file={folder}/counts"]
        child = [sys.executable, __file__, "--child", requests]
        try:
            process = subprocess.run(
                [*tool, *child], env=_environment(), capture_output=True, text=True, timeout=TIMEOUT_S
            )
        except subprocess.TimeoutExpired:
            raise NotCounted(f"valgrind took more than {TIMEOUT_S} s") from None
        if process.returncode:
            raise NotCounted(f"valgrind ended with code {process.returncode}: {process.stderr.splitlines()[-1]}")
        stages, libraries = {}, Counter()
        for file in sorted(Path(folder).glob("counts.*"), key=lambda file: int(file.suffix[1:])):
            with file.open() as lines:
                label, costs = read_counts(lines)
            if label:
                stages[label] = costs.total()
                libraries += costs
        return Counts(commit(), {**json.loads(process.stdout), **_tools(valgrind)}, stages, dict(libraries))


def _environment() -> dict[str, str]:
    from numpy._core._multiarray_umath import __cpu_dispatch__  # the instruction sets above numpy's baseline

    return {**os.environ, **ENVIRONMENT, "NPY_DISABLE_CPU_FEATURES": " ".join(__cpu_dispatch__)}


def _tools(valgrind: str) -> dict[str, str]:
    version = subprocess.run([valgrind, "--version"], capture_output=True, text=True, check=True).stdout.strip()
    return {"valgrind": version.removeprefix("valgrind-"), "processor": platform.machine()}


def run_comparison(requests: str) -> None:
    """Compare two clouds and write the counts of each stage; print the versions of the libraries as JSON."""
    import numpy
    import scipy
    from clouds import pair

    from pcbench import compare

    reference, candidate = pair("uniform city", POINTS)
    candidate = numpy.vstack([candidate, pair("uniform city", POINTS + 1)[1]])[: POINTS // 4]
    compare(reference[::2], {"candidate": candidate[::2]})  # imports everything
    callgrind, stages = ctypes.CDLL(requests), []

    def begin(step: str) -> None:
        if stages:
            callgrind.write_counts(stages[-1].encode())
        stages.append(step.removeprefix("candidate: "))

    callgrind.start_counting()
    compare(reference, {"candidate": candidate}, on_step=begin)
    callgrind.write_counts(stages[-1].encode())
    callgrind.stop_counting()
    print(json.dumps({"Python": platform.python_version(), "numpy": numpy.__version__, "scipy": scipy.__version__}))


def table(now: Counts, before: Counts | None) -> str:
    """Return the counts beside those of an earlier commit, with what grew in capitals."""
    pairs = [("total", sum(now.stages.values()), before and sum(before.stages.values()))]
    for counts in ("stages", "libraries"):
        a, b = getattr(now, counts), getattr(before, counts) if before else {}
        pairs += [(f"  {name}", a.get(name), b.get(name)) for name in {**a, **b}]
    lines = [f"{'instructions, millions':28}{now.commit:>20}{before.commit if before else '-':>20}{'change':>10}"]
    grown = []
    for name, a, b in pairs:
        growth = a / b - 1 if a and b else None
        is_grown = growth is not None and growth > GROWTH
        row = "".join(f"{n / 1e6:20.1f}" if n else f"{'-':>20}" for n in (a, b))
        change = f"{growth:+10.1%}" if growth is not None else f"{'-':>10}"
        lines.append(f"{name.upper() if is_grown else name:28}{row}{change}")
        grown += [f"{name.strip()} by {growth:.0%}"] if is_grown else []
    if before and (other := {k: v for k, v in before.versions.items() if now.versions.get(k) != v}):
        versions = ", ".join(f"{name} {version}, now {now.versions.get(name)}" for name, version in other.items())
        lines.append(f"the earlier commit was counted with {versions}: part of a change can be theirs")
    if grown:
        sentence = f"more instructions than at {before.commit}: {', '.join(grown)}"
        lines.append(f"{sentence.upper()}; if that is meant: python benchmarks/instructions.py --renew")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--renew", action="store_true")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        run_comparison(options.child)
        return
    try:
        runs = [count() for _ in range(options.runs)]
    except NotCounted as reason:
        print(f"instructions not counted: {reason}")
        return
    print(table(runs[0], Counts(**json.loads(BASELINE.read_text())) if BASELINE.exists() else None))
    if len(runs) > 1:
        totals = [sum(run.stages.values()) for run in runs]
        print(f"{len(runs)} runs differ by at most {(max(totals) - min(totals)) / min(totals):.4%} of the total")
    if options.renew and runs[0].commit.endswith("-dirty"):
        print(
            "not written: expected a clean working tree, because the counts name its commit: commit the changes first"
        )
    elif options.renew:
        BASELINE.write_text(json.dumps(runs[0]._asdict(), indent=2) + "\n")
        print(f"written: {BASELINE.name}")


if __name__ == "__main__":
    main()
