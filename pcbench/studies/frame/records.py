"""Results of runs that later runs of a study reuse, one JSON file each."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pcbench.errors import InputError
from pcbench.io.json_values import from_json, json_values, to_json
from pcbench.regular_files import read_json
from pcbench.studies.frame.folder import write_files

Result = TypeVar("Result")
_KEY = "key"  # in a record: the inputs that its values depend on
_VALUES_DIGEST = "values_sha256"  # in a record: SHA-256 of its other values


def read_record(path: Path, key: Mapping[str, Any], kind: type[Result]) -> Result | None:
    """Return the result that `write_record` saved for the same inputs.

    Returns None if there is none, if the inputs have changed, or if the file is damaged.

    Args:
        path: JSON file.
        key: all inputs that the result depends on, as JSON values.
        kind: type of the result, whose fields are the keys of the file.
    """
    try:
        values = read_json(path)
        if not isinstance(values, dict) or values.pop(_KEY, None) != json.loads(json.dumps(key)):
            return None
        return from_json(kind, values) if values.pop(_VALUES_DIGEST, None) == _digest(values) else None
    except (FileNotFoundError, InputError, AttributeError, KeyError, TypeError, ValueError):
        return None


def write_record(path: Path, key: Mapping[str, Any], result: object) -> None:
    """Save the result of a run for later runs with the same inputs.

    Args:
        path: JSON file to write.
        key: all inputs that the result depends on, as JSON values.
        result: a dataclass.

    Raises:
        OSError: the file cannot be written.
    """
    values = json_values(result)
    write_files(path.parent, {path.name: to_json({_KEY: key, _VALUES_DIGEST: _digest(values), **values})})


def _digest(values: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
