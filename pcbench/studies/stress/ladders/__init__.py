"""Ladders of perturbations, from nothing to certain failure, by kind."""

from pcbench.studies.stress.ladders.ladder import Ladder, displaced
from pcbench.studies.stress.ladders.names import LADDERS, selected

__all__ = ["LADDERS", "Ladder", "displaced", "selected"]
