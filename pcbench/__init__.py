"""pcbench: how far is this point cloud from that one, where, why, and which numbers can be trusted?"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from pcbench.deformation import deform as deform
    from pcbench.errors import PcbenchError as PcbenchError
    from pcbench.geometry.cloud import Cloud as Cloud
    from pcbench.geometry.transform import Affine as Affine
    from pcbench.geometry.transform import Similarity as Similarity
    from pcbench.io import read_cloud as read_cloud
    from pcbench.io import write_cloud as write_cloud
    from pcbench.measure import metrics as metrics
    from pcbench.measure.settings import Settings as Settings
    from pcbench.registration import register as register
    from pcbench.report.comparison import Comparison as Comparison
    from pcbench.report.comparison import compare as compare

# Looked up on first use: a name costs the import of its own room only.
_ROOMS = {
    "Affine": "geometry.transform",
    "Cloud": "geometry.cloud",
    "Comparison": "report.comparison",
    "PcbenchError": "errors",
    "Settings": "measure.settings",
    "Similarity": "geometry.transform",
    "compare": "report.comparison",
    "deform": "deformation",
    "metrics": "measure.metrics",
    "read_cloud": "io",
    "register": "registration",
    "write_cloud": "io",
}

__all__ = ["__version__", *_ROOMS]


def __getattr__(name: str) -> Any:
    value: Any
    if name == "__version__":
        value = _version()
    elif name in _ROOMS:
        module = import_module(f"pcbench.{_ROOMS[name]}")
        value = module if name == "metrics" else getattr(module, name)
    else:
        raise AttributeError(f"module 'pcbench' has no attribute {name!r}")
    globals()[name] = value
    return value


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version  # a quarter of the package's import time

    try:
        return version("pcbench")
    except PackageNotFoundError:  # a source tree that was never installed
        return "0+unknown"
