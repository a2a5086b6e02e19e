"""Bringing a candidate onto the reference, and saying how far that can be trusted."""

from pcbench.registration.control_points import ControlPoints
from pcbench.registration.from_features import FeatureSettings
from pcbench.registration.given import GivenPose, as_similarity
from pcbench.registration.icp import IcpSettings
from pcbench.registration.methods import METHODS, Method, as_method, parse_method, register
from pcbench.registration.result import CheckPoint, Registration
from pcbench.registration.target import Target, local_origin

__all__ = [
    "METHODS",
    "CheckPoint",
    "ControlPoints",
    "FeatureSettings",
    "GivenPose",
    "IcpSettings",
    "Method",
    "Registration",
    "Target",
    "as_method",
    "as_similarity",
    "local_origin",
    "parse_method",
    "register",
]
