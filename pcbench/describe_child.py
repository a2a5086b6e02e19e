"""The describing process: `python -m pcbench.describe_child SPEC FILE` writes what a reconstructor is, as JSON."""

from __future__ import annotations

import inspect
import json
import sys
from pathlib import Path
from typing import Any

from pcbench.errors import PcbenchError
from pcbench.io.files import digest
from pcbench.plugins import find_plugin


def main(spec: str, file: Path) -> None:
    outcome: dict[str, Any]
    try:
        plugin = find_plugin(spec)
        source = inspect.getsourcefile(plugin.cls)
        outcome = {
            "settings": [setting.name for setting in plugin.settings],
            "origin": plugin.origin,
            "sha256": digest(Path(source)) if source else None,
        }
    except PcbenchError as error:
        outcome = {"problem": str(error)}
    file.write_text(json.dumps(outcome), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
