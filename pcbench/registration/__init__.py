"""Registration of a candidate to the reference, with an assessment of how far the pose can be trusted."""

from pcbench.registration.control_points import ControlPoints
from pcbench.registration.from_features import FeatureSettings
from pcbench.registration.given import GivenPose, as_similarity
from pcbench.registration.icp_settings import IcpSettings
from pcbench.registration.methods import METHODS, Method, as_method, parse_method, register
from pcbench.registration.motion import RemovedMotion
from pcbench.registration.residuals import PointResidual, PointRmse, SurveyResiduals
from pcbench.registration.result import Registration
from pcbench.registration.target import Target, local_origin, local_origin_of_box
from pcbench.registration.trajectories import TrajectorySettings

__all__ = [
    "METHODS",
    "ControlPoints",
    "FeatureSettings",
    "GivenPose",
    "IcpSettings",
    "Method",
    "PointResidual",
    "PointRmse",
    "Registration",
    "RemovedMotion",
    "SurveyResiduals",
    "Target",
    "TrajectorySettings",
    "as_method",
    "as_similarity",
    "local_origin",
    "local_origin_of_box",
    "parse_method",
    "register",
]
