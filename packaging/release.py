"""Prepare a release in a clean clone: `make release VERSION=0.2.0`.

The version is set in all files that state it, the section "Unreleased" of the changelog is dated, the wheels, the
source distribution and the site are built, and the change is committed with a tag. What needs other
machines or a decision is printed as a list. If a step fails, nothing is committed.
"""

import datetime
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
VERSION_LINES = {  # files that state the version, and the start of the line
    "pyproject.toml": 'version = "',
    "packaging/conda/recipe.yaml": '  version: "',
    "packaging/qgis/pcbench_algorithms/metadata.txt": "version=",
}
BUILDS = ("wheels", "sdist", "docs", "stale")  # targets of make, in order

REMAINING = """
Version {version} is committed and tagged here. What remains:
[ ] measured: above are the tables that are older than their code: measure them again, or name what was not
[ ] wheels: `cibuildwheel` on Linux, macOS and Windows (.github/workflows/ci.yml); those in dist/ need this C library
[ ] push: git push origin HEAD v{version}
[ ] upload: twine upload dist/*{version}*
[ ] site: publish the folder site/
[ ] conda: set the checksum of packaging/conda/recipe.yaml from dist/pcbench-{version}.tar.gz
"""


def main() -> None:
    """Prepare the release named by the command line, or say why not."""
    if len(sys.argv) != 2:
        sys.exit("usage: release.py VERSION")
    version = sys.argv[1]
    try:
        prepare(ROOT, version, datetime.date.today())
        for target in BUILDS:
            subprocess.run(["make", target], cwd=ROOT, check=True)
        commit(ROOT, version)
    except (ValueError, subprocess.CalledProcessError) as error:
        sys.exit(f"{version} is not released: {error}")
    print(REMAINING.format(version=version))


def prepare(root: Path, version: str, date: datetime.date) -> None:
    """Write the version and the date of a release into a clean clone.

    Raises:
        ValueError: the clone has changes, the version does not follow the last one, or the changelog has no news.
    """
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        raise ValueError(f"expected a version such as 0.2.0, got {version}")
    if changes := git(root, "status", "--porcelain"):
        raise ValueError(f"the clone has changes:\n{changes}")
    texts = {name: (root / name).read_text() for name in (*VERSION_LINES, "CHANGELOG.md")}
    for name, start in VERSION_LINES.items():
        line = re.search(rf"^{re.escape(start)}(\d+\.\d+\.\d+)", texts[name], re.MULTILINE)
        if line is None:
            raise ValueError(f"{name} states no version")
        if _numbers(version) <= _numbers(line[1]):
            raise ValueError(f"{name} has version {line[1]} already")
        texts[name] = texts[name].replace(line[0], start + version, 1)
    before, heading, after = texts["CHANGELOG.md"].partition("## Unreleased\n")
    if not after.partition("\n## ")[0].strip():
        raise ValueError("the changelog has nothing under Unreleased")
    texts["CHANGELOG.md"] = f"{before}{heading}\n## {version} ({date.isoformat()})\n{after}"
    for name, text in texts.items():
        (root / name).write_text(text)


def commit(root: Path, version: str) -> None:
    """Commit the files of a release and tag the commit."""
    git(root, "commit", "--quiet", "--message", f"Version {version}", *VERSION_LINES, "CHANGELOG.md")
    git(root, "tag", "--annotate", f"v{version}", "--message", f"Version {version}")


def git(root: Path, *arguments: str) -> str:
    """Run git in a clone and return its output."""
    return subprocess.run(["git", "-C", root, *arguments], capture_output=True, text=True, check=True).stdout


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))


if __name__ == "__main__":
    main()
