"""Child process `describe_child SPEC FILE`: write a reconstructor's description as JSON."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pcbench.errors import PcbenchError
from pcbench.plugins import find_plugin
from pcbench.plugins.code import digest_files, plugin_files


def main(spec: str, file: Path) -> None:
    """Write the description of a reconstructor, or the problem with it."""
    outcome: dict[str, Any]
    try:
        plugin = find_plugin(spec)
        outcome = {
            "settings": [setting.name for setting in plugin.settings],
            "origin": plugin.origin,
            "sha256": digest_files(plugin_files(plugin.cls.__module__)),
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
