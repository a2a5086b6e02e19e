"""Values that all tasks of a stage have in common, passed as a file: arguments of tasks travel with each of them."""

from __future__ import annotations

import pickle
from functools import lru_cache
from pathlib import Path
from typing import Any


def share(value: object, file: Path) -> None:
    """Store a value for `load_shared`."""
    temporary = file.with_suffix(".partial")
    temporary.write_bytes(pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL))
    temporary.replace(file)


@lru_cache(maxsize=2)
def load_shared(file: Path, key: str) -> Any:
    """Return a shared value; `key` identifies it, since a worker keeps it for further tasks."""
    return pickle.loads(file.read_bytes())
