"""The package as installed: its import must be fast and must not load heavy libraries."""

import functools
import re
import subprocess
import sys
import tomllib

import pytest
import repository

HEAVY_LIBRARIES = (
    "scipy",
    "torch",
    "pycolmap",
    "pyvista",
    "vtk",
    "open3d",
    "trimesh",
    "lazrs",
    "pye57",
    "matplotlib",
    "rich",
    "kiss_matcher",
)


def loaded_modules(code):
    script = f"import sys\n{code}\nprint('\\n'.join(sys.modules))"
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return {name.partition(".")[0] for name in process.stdout.split()}


def test_import_loads_no_heavy_library():
    code = (
        "import pcbench\n"
        "pcbench.Cloud, pcbench.Settings, pcbench.compare, pcbench.metrics, pcbench.plot, pcbench.read_cloud\n"
        "pcbench.register\n"
    )
    assert not loaded_modules(code) & set(HEAVY_LIBRARIES)


def test_dir_imports_nothing():
    modules = loaded_modules("import pcbench\nassert {'Cloud', 'Mesh', 'read_scene'} <= set(dir(pcbench))")
    assert "numpy" not in modules


def test_help_imports_nothing_heavy():
    code = "from pcbench import cli\ntry: cli.app(['--help'])\nexcept SystemExit: pass"
    assert not loaded_modules(code) & {*HEAVY_LIBRARIES, "numpy"}


def test_public_names():
    import pcbench

    assert set(pcbench.__all__) <= set(dir(pcbench))

    for name in pcbench.__all__:
        assert getattr(pcbench, name) is not None
    assert callable(pcbench.compare)
    import pcbench.comparison

    assert callable(pcbench.compare)


def test_dir_lists_exactly_the_public_names():
    import pcbench

    names = [name for name in dir(pcbench) if not name.startswith("_")]
    assert names == sorted(name for name in pcbench.__all__ if not name.startswith("_"))
    assert {"Index", "compare", "read_cloud"} <= set(names)


# Module names of distributions that are imported under another name.
IMPORTED_AS = {"pillow": "PIL", "kiss-matcher": "kiss_matcher", "cuda-core": "cuda", "nvidia-cuda-nvrtc": "cuda"}


@functools.cache
def imported_modules(folder):
    """Return all modules that the code in a folder imports, by a statement or by `pcbench.extras.require`."""
    modules = set()
    for file in (repository.ROOT / folder).rglob("*.py"):
        text = file.read_text()
        modules |= set(re.findall(r"^ *(?:import|from) (\w+)", text, re.MULTILINE))
        modules |= set(re.findall(r"\brequire\(\s*\"(\w+)", text))
    return modules


EXTRAS = tomllib.loads((repository.ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
PUBLIC_EXTRAS = [name for name in EXTRAS if name not in ("all", "docs", "dev")]


@pytest.mark.parametrize("extra", PUBLIC_EXTRAS)
def test_extras_install_only_imported_libraries(extra):
    modules = imported_modules("pcbench") | imported_modules("reconstructors")
    for requirement in EXTRAS[extra]:
        name = re.match(r"[\w-]+", requirement)[0]
        assert IMPORTED_AS.get(name, name) in modules, f"no code imports {name}"


def test_extra_all_contains_the_others():
    """The exceptions are `cuda`, which needs a GPU, and `meshlab`, whose library has the GPL."""
    others = (name for name in PUBLIC_EXTRAS if name not in ("cuda", "meshlab"))
    assert EXTRAS["all"] == [f"pcbench[{','.join(others)}]"]
