"""Bringing a candidate onto the reference."""

from pcbench.registration.icp import METHODS, CheckPoint, Registration, Target, fit_pairs, local_origin, register

__all__ = ["METHODS", "CheckPoint", "Registration", "Target", "fit_pairs", "local_origin", "register"]
