"""Print what pcbench and some of its extras require, one per line: `python packaging/requirements.py plot sfm`."""

import sys
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
extras = (project["optional-dependencies"][name] for name in sys.argv[1:])
print(*project["dependencies"], *(requirement for extra in extras for requirement in extra), sep="\n")
