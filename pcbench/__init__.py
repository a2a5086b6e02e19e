"""pcbench: how far is this point cloud from that one, where, why, and which numbers can be trusted?"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from pcbench.comparison.result import Comparison as Comparison
    from pcbench.comparison.run import compare as compare
    from pcbench.deformation import deform as deform
    from pcbench.errors import PcbenchError as PcbenchError
    from pcbench.geometry.cloud import Cloud as Cloud
    from pcbench.geometry.mesh import Mesh as Mesh
    from pcbench.geometry.neighbors import Index as Index
    from pcbench.geometry.region_text import parse_region as parse_region
    from pcbench.geometry.regions import Box as Box
    from pcbench.geometry.regions import Polygon as Polygon
    from pcbench.geometry.regions import Region as Region
    from pcbench.geometry.regions import Sphere as Sphere
    from pcbench.geometry.regions import Union as Union
    from pcbench.geometry.transform import Affine as Affine
    from pcbench.geometry.transform import Similarity as Similarity
    from pcbench.io import read_cloud as read_cloud
    from pcbench.io import write_cloud as write_cloud
    from pcbench.io.crop import crop as crop
    from pcbench.io.meshes import read_mesh as read_mesh
    from pcbench.measure import metrics as metrics
    from pcbench.measure.m3c2_settings import M3C2Settings as M3C2Settings
    from pcbench.measure.score_pairs import CloudScore as CloudScore
    from pcbench.measure.score_pairs import score as score
    from pcbench.measure.score_pairs import score_many as score_many
    from pcbench.measure.settings import Settings as Settings
    from pcbench.measure.tiled.settings import TilingSettings as TilingSettings
    from pcbench.registration import IcpSettings as IcpSettings
    from pcbench.registration import Registration as Registration
    from pcbench.registration import register as register
    from pcbench.report import plotters as plot  # noqa: F401  # a public name, as the others
    from pcbench.scenes import Scene as Scene
    from pcbench.scenes import read_scene as read_scene
    from pcbench.studies.evaluate.study import evaluate as evaluate

# Imported on first use, so that a name costs the import of one subpackage only.
_MODULES = {
    "Affine": "geometry.transform",
    "Box": "geometry.regions",
    "Cloud": "geometry.cloud",
    "CloudScore": "measure.score_pairs",
    "Comparison": "comparison.result",
    "IcpSettings": "registration",
    "Index": "geometry.neighbors",
    "M3C2Settings": "measure.m3c2_settings",
    "Mesh": "geometry.mesh",
    "PcbenchError": "errors",
    "Polygon": "geometry.regions",
    "Region": "geometry.regions",
    "Registration": "registration",
    "Scene": "scenes",
    "Settings": "measure.settings",
    "Similarity": "geometry.transform",
    "Sphere": "geometry.regions",
    "TilingSettings": "measure.tiled.settings",
    "Union": "geometry.regions",
    "compare": "comparison.run",
    "crop": "io.crop",
    "deform": "deformation",
    "evaluate": "studies.evaluate.study",
    "metrics": "measure.metrics",
    "parse_region": "geometry.region_text",
    "plot": "report.plotters",
    "read_cloud": "io",
    "read_mesh": "io.meshes",
    "read_scene": "scenes",
    "register": "registration",
    "score": "measure.score_pairs",
    "score_many": "measure.score_pairs",
    "write_cloud": "io",
}

__all__ = ["__version__", *_MODULES]


def __getattr__(name: str) -> Any:
    value: Any
    if name == "__version__":
        from pcbench.extras import package_version  # slow: a quarter of the package's import time

        value = package_version()
    elif name in _MODULES:
        module = import_module(f"pcbench.{_MODULES[name]}")
        value = module if name in ("metrics", "plot") else getattr(module, name)
    else:
        raise AttributeError(f"module 'pcbench' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *(name for name in globals() if name.startswith("__") and name not in __all__)])
