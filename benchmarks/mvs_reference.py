"""MVS as the reference, next to the true surface: python benchmarks/mvs_reference.py

Sparse SfM of a synthetic city, with solved cameras and georeferenced by GPS, is compared with the dense cloud that
`mvs` computes from the same images and cameras, as Gao et al. do with COLMAP's, and with the true surface. Both
comparisons are by `pcbench compare`; their tables are printed side by side.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from difflib import SequenceMatcher
from pathlib import Path

from measure import setting

SCENE = "--images 20 --size 480x320 --extent 100 --rig oblique --gps 0.5 --points 200000 --seed 5"
SOLVE_OPTIONS = ("--cameras", "none", "--set", "poses=solve")
OWN_OPTIONS = {"sfm": (), "mvs": ("--set", "views=3")}  # a reference has points on which three images agree
COMPARE_OPTIONS = ("--register", "none", "--no-figures", "--thresholds")


def pcbench(*arguments: object) -> str:
    """Run a command and return its output."""
    command = [sys.executable, "-m", "pcbench.cli", *map(str, arguments)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def table_rows(output: str) -> list[tuple[str, list[str]]]:
    """Return the rows of the table in the output of `pcbench compare`, after the line with the directions."""
    lines = iter(output.splitlines())
    next(line for line in lines if "r→c" in line)
    parsed = []
    for line in lines:
        if not line.strip():
            break
        label, *cells = re.split(r"\s{2,}", line.strip())
        parsed.append((" " * (len(line) - len(line.lstrip())) + label, cells))
    return parsed


def side_by_side(left: str, right: str) -> str:
    """Merge two tables of `pcbench compare`; a row of only one table is empty in the other."""
    tables = table_rows(left), table_rows(right)
    labels = [[label for label, _ in table] for table in tables]
    lines = []
    for _, left_start, left_end, right_start, right_end in SequenceMatcher(None, *labels, autojunk=False).get_opcodes():
        for index in range(max(left_end - left_start, right_end - right_start)):
            left_row = tables[0][left_start + index] if left_start + index < left_end else ("", [])
            right_row = tables[1][right_start + index] if right_start + index < right_end else ("", [])
            if left_row[0] == right_row[0]:
                lines.append((left_row[0], left_row[1], right_row[1]))
            else:
                lines += [
                    (label, *cells)
                    for label, cells in ((left_row[0], (left_row[1], [])), (right_row[0], ([], right_row[1])))
                    if label
                ]
    return "\n".join(
        f"{label:26}{format_cells(left_cells)}{format_cells(right_cells)}".rstrip()
        for label, left_cells, right_cells in lines
    )


def format_cells(cells: list[str]) -> str:
    """Return the cells of both directions as text; a symmetric value is in the first column."""
    return "".join(f"{cell:>12}" for cell in [*cells, "", ""][:2])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default=SCENE, help=f"Options of `pcbench synth city`.  [default: {SCENE}]")
    parser.add_argument("--threshold", default="0.5", help="Threshold of precision and recall, in metres.")
    parser.add_argument("--folder", type=Path, help="Folder that keeps all files; existing ones are used again.")
    options = parser.parse_args()
    print(setting())
    with tempfile.TemporaryDirectory() as temporary:
        root = options.folder or Path(temporary)
        root.mkdir(parents=True, exist_ok=True)
        city = root / "city"
        if not city.exists():
            pcbench("synth", "city", "--out", city, "--quiet", *options.scene.split())
        for name, own_options in OWN_OPTIONS.items():
            pcbench("reconstruct", name, city, "--out", root / f"{name}.ply", *SOLVE_OPTIONS, *own_options, "--quiet")
        outputs = []
        for reference in (root / "mvs.ply", city / "truth" / "cloud.ply"):
            report = root / f"against_{reference.stem}"
            output = pcbench(
                "compare", reference, root / "sfm.ply", "--out", report, *COMPARE_OPTIONS, options.threshold
            )
            outputs.append(output.replace(f"{root}/", ""))
            print(outputs[-1].split("\n\n")[0], end="\n\n")
        print(
            f"{'':26}{'against MVS':>24}{'against the truth':>24}\n{'':26}{'c→r':>12}{'r→c':>12}{'c→r':>12}{'r→c':>12}"
        )
        print(side_by_side(*outputs))


if __name__ == "__main__":
    main()
