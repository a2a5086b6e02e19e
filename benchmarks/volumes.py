"""Coverage of 95 % intervals of volumes, and net volumes beside other tools: `python benchmarks/volumes.py`.

Each run makes two epochs of points with new errors and one of five changes of exact volume (tests/volume_cases.py). A
cell has the share of runs whose interval holds the truth and, for net volumes, half the median width of the intervals
over 1.96 times the root mean square of the errors. With `--runs 0` only the other tools run, see volumes_peers.py.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from measure import limit_threads, setting
from real_data import data_note, data_root
from volumes_peers import print_peers

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from volume_cases import CHANGES, cases, run

KINDS = ("net", "zone", "part", "fill", "cut")
TERRAINS = ("plane", "ramp", "hills", "rough")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--terrains", nargs="*", default=TERRAINS)
    parser.add_argument("--xdem-python", type=Path, help="a Python that has xDEM; xDEM is not measured without")
    options = parser.parse_args()
    limit_threads(1)
    print(setting() + data_note())
    if options.runs:
        _print_coverage(options.runs, options.terrains)
    data = data_root()
    if data is None:
        return
    print_peers(data, options.xdem_python)


def _print_coverage(count: int, terrains: list[str]) -> None:
    print(f"\n{'terrain, errors':28}" + "".join(f"{kind:>14}" for kind in KINDS))
    for number, (name, case) in enumerate(cases(terrains)):
        line = f"{name:28}"
        runs = [run(case, CHANGES[k % len(CHANGES)], 1000 * number + k) for k in range(count)]
        for kind in KINDS:
            pairs = [(each.measured[kind], each.true[kind]) for each in runs if kind in each.measured]
            held = np.mean([m.low <= true <= m.high for m, true in pairs])
            error = np.sqrt(np.mean([(m.value - true) ** 2 for m, true in pairs]))
            width = np.median([m.high - m.low for m, _ in pairs]) / (2 * 1.96 * error)
            line += f"{held:7.2f} ({width:4.2f})" if kind in ("net", "zone", "part") else f"{held:14.2f}"
        print(line, flush=True)


if __name__ == "__main__":
    main()
