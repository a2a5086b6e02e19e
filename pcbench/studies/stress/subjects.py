"""All subjects of the study by name, in the order of tables and pages."""

from __future__ import annotations

from typing import Any

from pcbench.studies.stress.changes import CHANGES
from pcbench.studies.stress.metrics import METRICS
from pcbench.studies.stress.reconstructors.reconstruction import RECONSTRUCTION
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.subject import PairSubject, Subject
from pcbench.studies.stress.verdicts import VERDICTS

PAIR_SUBJECTS: dict[str, PairSubject[Any]] = {
    subject.name: subject for subject in (REGISTRATION, METRICS, VERDICTS, CHANGES)
}
SUBJECTS: dict[str, Subject[Any]] = {**PAIR_SUBJECTS, RECONSTRUCTION.name: RECONSTRUCTION}
