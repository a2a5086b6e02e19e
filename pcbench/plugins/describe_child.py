"""The describing process: `describe_child SPEC FILE` writes what a reconstructor is, as JSON."""

from __future__ import annotations

import hashlib
import inspect
import json
import sys
from pathlib import Path
from typing import Any

from pcbench.errors import PcbenchError
from pcbench.io.files import digest
from pcbench.plugins import find_plugin


def _digest(source: Path) -> str:
    """Of a plugin's file, and of what it imported from beside it."""
    files = {Path(str(getattr(module, "__file__", ""))) for module in list(sys.modules.values())}
    beside = {file for file in files if file.suffix == ".py" and file.parent == source.parent}
    return hashlib.sha256("".join(digest(file) for file in sorted({source, *beside})).encode()).hexdigest()


def main(spec: str, file: Path) -> None:
    outcome: dict[str, Any]
    try:
        plugin = find_plugin(spec)
        source = inspect.getsourcefile(plugin.cls)
        outcome = {
            "settings": [setting.name for setting in plugin.settings],
            "origin": plugin.origin,
            "sha256": _digest(Path(source)) if source else None,
            "help": plugin.help,
            "more": plugin.docstring.partition("\n\n")[2],
            "missing": plugin.missing,
            "types": [setting.type for setting in plugin.settings],
            "defaults": [setting.default for setting in plugin.settings],
        }
    except PcbenchError as error:
        outcome = {"problem": str(error)}
    file.write_text(json.dumps(outcome), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
