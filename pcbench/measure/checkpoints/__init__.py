"""Accuracy of a cloud by check points: heights of its surface at surveyed points, and the statistics of standards."""

from pcbench.measure.checkpoints.accuracy import CloudAccuracy, PointError, assess
from pcbench.measure.checkpoints.neighbors import PlanNeighbors
from pcbench.measure.checkpoints.settings import CheckPointSettings

__all__ = ["CheckPointSettings", "CloudAccuracy", "PlanNeighbors", "PointError", "assess"]
