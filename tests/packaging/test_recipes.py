"""The conda recipe and the container file agree with pyproject.toml."""

import re
import subprocess
import sys
import tomllib

import pytest
from repository import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_conda_recipe_has_version_and_dependencies_of_the_project():
    yaml = pytest.importorskip("yaml")
    recipe = yaml.safe_load((ROOT / "packaging/conda/recipe.yaml").read_text())
    project, build = PROJECT["project"], PROJECT["build-system"]
    assert recipe["context"]["version"] == project["version"]
    assert recipe["about"]["license"] == project["license"]
    assert recipe["about"]["summary"] == project["description"]
    python, *run = recipe["requirements"]["run"]
    assert python == f"python {project['requires-python']}"
    assert [line.replace(" ", "") for line in run] == project["dependencies"]
    assert {line.replace(" ", "") for line in recipe["requirements"]["host"] if isinstance(line, str)} >= set(
        build["requires"]
    )


def test_container_file_names_extras_of_the_project():
    text = (ROOT / "packaging/Containerfile").read_text()
    extras = {extra for found in re.findall(r"\[([a-z0-9,]+)\]", text) for extra in found.split(",")}
    assert {"cuda", "plot"} <= extras <= set(PROJECT["project"]["optional-dependencies"])


def test_printed_requirements_are_those_of_the_project_and_its_extras():
    def printed(*extras):
        script = ROOT / "packaging/requirements.py"
        return subprocess.run([sys.executable, script, *extras], capture_output=True, text=True)

    extras = PROJECT["project"]["optional-dependencies"]
    expected = [*PROJECT["project"]["dependencies"], *extras["plot"], *extras["sfm"]]
    assert printed("plot", "sfm").stdout.splitlines() == expected
    assert not any("pcbench" in line for line in expected)  # pip would look for it in the index
    assert printed("nothing").returncode != 0
