"""Build the wheels and test them in empty environments: `make wheels`.

CPython 3.11 has its own wheel. The wheel built with 3.12 uses the stable ABI and serves later versions too. A cross
compiler (Debian's g++-aarch64-linux-gnu) builds the same two for ARM, which are not run. The tag of a wheel states
the C library of this machine; cibuildwheel builds for older ones in a container (pyproject.toml, `tool.cibuildwheel`).

Each wheel runs the demo and a comparison with each Python on this machine that it serves: with the highest allowed
versions of the dependencies, and with the Python it was built by also with the lowest.
"""

import os
import platform
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
BUILDERS = ("3.11", "3.12")
VERSIONS = (*BUILDERS, "3.13", "3.14")
ARM_COMPILER = "aarch64-linux-gnu-g++"


def main() -> int:
    """Build, repair and test the wheels, and print one line for each; return the number of failures."""
    for folder in ("dist", "build/dist"):
        shutil.rmtree(ROOT / folder, ignore_errors=True)
    pythons = {version: python for version in VERSIONS if (python := find_python(version))}
    for version in VERSIONS:
        if version not in pythons:
            print(f"Python {version}: not on this machine, not tested")
    for version in BUILDERS:
        if version in pythons:
            build(pythons[version])
            if shutil.which(ARM_COMPILER) and platform.machine() == "x86_64":
                build(pythons[version], *arm(version))
    wheels = sorted((ROOT / "dist").glob("*.whl"))
    check_contents(wheels)
    failures = 0
    for wheel in wheels:
        if not wheel.stem.endswith(platform.machine()):
            print(f"{wheel.name}: not run, for another processor")
            continue
        for version in served(wheel):
            if version in pythons:
                for requirements in [lowest_requirements()] * (version in BUILDERS) + [[]]:
                    failures += not try_wheel(wheel, pythons[version], requirements)
    return failures


def find_python(version: str) -> str | None:
    """Return the path of an interpreter, or None if this machine lacks it. pyenv has names of versions that fail."""
    command = [f"python{version}", "-c", "import sys; print(sys.executable)"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def build(python: str, environment: Mapping[str, str] | None = None, *settings: str) -> None:
    """Build a wheel with an interpreter, and put it into dist/ with the libraries that it needs (OpenMP)."""
    folder = ROOT / "build" / "dist"
    with tempfile.TemporaryDirectory() as scratch:
        pip = new_environment(python, Path(scratch))
        options = [option for setting in settings for option in ("--config-settings", setting)]
        run(*pip, "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, *options, ROOT, environment=environment)
    newest = max(folder.glob("*.whl"), key=lambda path: path.stat().st_mtime)
    tools = {"PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])}
    run(sys.executable, "-m", "auditwheel", "repair", "--wheel-dir", ROOT / "dist", newest,
        environment=tools | dict(environment or {}))  # fmt: skip


def arm(version: str) -> tuple[dict[str, str], str, str]:
    """Return the environment and the settings that build a wheel for ARM."""
    soabi = f"cpython-{version.replace('.', '')}-aarch64-linux-gnu"
    environment = {
        "CXX": ARM_COMPILER,
        "_PYTHON_HOST_PLATFORM": "linux-aarch64",
        "SETUPTOOLS_EXT_SUFFIX": f".{soabi}.so",
        "LD_LIBRARY_PATH": "/usr/aarch64-linux-gnu/lib",  # where auditwheel finds libgomp
    }
    return environment, "cmake.define.CMAKE_SYSTEM_NAME=Linux", "cmake.define.CMAKE_SYSTEM_PROCESSOR=aarch64"


def check_contents(wheels: list[Path]) -> None:
    """Run the tests of the files in wheels."""
    names = {"PCBENCH_WHEELS": " ".join(f"dist/{wheel.name}" for wheel in wheels)}
    run(sys.executable, "-m", "pytest", "-q", ROOT / "tests" / "test_wheel.py", environment=names)


def served(wheel: Path) -> Iterator[str]:
    """Yield the versions of Python that can install a wheel."""
    _, _, python, abi, _ = wheel.stem.split("-")
    for version in VERSIONS:
        tag = "cp" + version.replace(".", "")
        if tag == python or (abi == "abi3" and tag > python):
            yield version


def lowest_requirements() -> list[str]:
    """Return the lowest allowed version of each dependency, such as numpy==2.0."""
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    return [dependency.replace(">=", "==") for dependency in dependencies]


def try_wheel(wheel: Path, python: str, requirements: list[str]) -> bool:
    """Install a wheel in an empty environment, run the demo and a comparison, and print the result and the versions."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        pip = new_environment(python, folder / "venv")
        no_pins = {"PIP_CONSTRAINT": ""}  # `make` pins the versions that build
        run(*pip, "install", "--quiet", "--only-binary", ":all:", wheel, *requirements, environment=no_pins)
        versions = run(*pip, "freeze", "--exclude", "pcbench").split()
        pcbench = folder / "venv" / "bin" / "pcbench"
        clouds = (folder / "demo" / "clouds" / f"{name}.ply" for name in ("reference", "sparse"))
        try:
            run(pcbench, "demo", "--points", "20000", "--no-bench", "--no-figures", "--out", folder / "demo")
            run(pcbench, "compare", *clouds, "--no-figures", "--out", folder / "report")
        except subprocess.CalledProcessError as error:  # which has printed its message
            print(error)
        is_complete = (folder / "report" / "report.html").is_file()
        print(f"{wheel.name}: {python}: {'passed' if is_complete else 'FAILED'}: {', '.join(versions)}", flush=True)
        return is_complete


def new_environment(python: str, folder: Path) -> list[str]:
    """Make an empty environment, and return the command of its pip."""
    run(python, "-m", "venv", folder)
    return [str(folder / "bin" / "python"), "-m", "pip", "--disable-pip-version-check"]


def run(*command: str | Path, environment: Mapping[str, str] | None = None) -> str:
    """Run a command outside of the source tree, whose packages would be imported first, and return its output."""
    return subprocess.run(
        list(map(str, command)),
        env={**os.environ, **(environment or {})},
        cwd=tempfile.gettempdir(),
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    ).stdout


if __name__ == "__main__":
    sys.exit(main())
