"""`pcbench stress --reconstructors`: how reconstructors degrade on worse photographs, and whether they say so."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pcbench.errors import InputError
from pcbench.extras import installed_versions
from pcbench.plugins.run import Description, absolute, describe
from pcbench.report.document import provenance
from pcbench.scenes.synthetic.render import check_renderer
from pcbench.studies.bench.plan import labels
from pcbench.studies.frame.folder import study_folder
from pcbench.studies.frame.publish import StudyOutcome
from pcbench.studies.stress.descriptions import LadderInfo, MethodInfo, MissingMethod
from pcbench.studies.stress.reconstructors.ladders import PhotoLadder, selected
from pcbench.studies.stress.reconstructors.reconstruction import RECONSTRUCTION, UNPERTURBED
from pcbench.studies.stress.reconstructors.runs import (
    PhotoRuns,
    ReconstructorMethod,
    plan_photo_runs,
    run_photo_plans,
)
from pcbench.studies.stress.results import KIND, StressSettings, StressStudy
from pcbench.studies.stress.study import PHOTOGRAPHS, check_study, write_study

DEFAULT_METHODS = ("sfm", "mvs", "splat")
QUICK_METHODS = ("sfm", "mvs")
# Settings that differ from the defaults. `sfm` solves for its cameras, because its points alone test little. `splat`
# trains for less time, on images that are small anyway.
_SETTINGS: Mapping[str, Mapping[str, str]] = {"sfm": {"poses": "solve"}, "splat": {"steps": "600"}}
_UNPERTURBED_INFO = LadderInfo(
    UNPERTURBED, UNPERTURBED, UNPERTURBED, (RECONSTRUCTION.name,), "", (0.0,), (UNPERTURBED,)
)


@dataclass(frozen=True)
class PhotoPlan:
    """Plan of a study of reconstructors.

    Attributes:
        ladders: ladders.
        methods: methods by name.
        missing: methods that are left out, with the reason.
    """

    ladders: tuple[PhotoLadder, ...]
    methods: Mapping[str, ReconstructorMethod]
    missing: tuple[MissingMethod, ...]

    @classmethod
    def of(cls, settings: StressSettings) -> PhotoPlan:
        """Return the plan of settings, without methods that cannot run here.

        Raises:
            InputError: there is no such ladder or method, or none of the methods can run here.
        """
        ladders = selected(settings.only, quick=settings.quick)
        specs = settings.methods or (QUICK_METHODS if settings.quick else DEFAULT_METHODS)
        methods: dict[str, ReconstructorMethod] = {}
        missing: list[MissingMethod] = []
        for name, spec in zip(labels(specs), specs, strict=True):
            description = describe(absolute(spec))
            if description.problem is not None:
                raise InputError(f"expected reconstructors as --methods, got {spec!r}: {description.problem}")
            if description.missing is not None:
                missing.append(MissingMethod(name, description.missing))
            else:
                methods[name] = ReconstructorMethod(name, spec, _SETTINGS.get(spec, {}), description)
        if not methods:
            raise InputError(missing[0].reason)
        return cls(ladders, methods, tuple(missing))

    def infos(self) -> tuple[MethodInfo, ...]:
        """Return the descriptions of the methods."""
        return tuple(_info(method.name, method.description) for method in self.methods.values())


def run_reconstructor_stress(
    out: Path,
    settings: StressSettings,
    *,
    plan: PhotoPlan | None = None,
    figures: bool = True,
    step: Callable[[str], None] = lambda _: None,
) -> StudyOutcome[StressStudy]:
    """Run reconstructors on perturbed photographs, and write the same files as `run_stress` to a folder.

    The records of all runs stay in its folder `runs`, and rendered scenes in `scenes`; a later run with the same
    settings resumes from them.

    Args:
        out: output folder.
        settings: settings of the study.
        plan: plan of the study; by default that of the settings.
        figures: whether to draw charts.
        step: progress callback.

    Raises:
        InputError: a setting is not usable, or `out` holds something else, or another run is writing there.
        MissingExtra, NoFiguresError: images cannot be rendered on this machine.
        OSError: a file cannot be written.
    """
    check_study(out, PHOTOGRAPHS)
    check_renderer()
    step("inspecting the methods")
    plan = PhotoPlan.of(settings) if plan is None else plan
    seeds = range(settings.seed, settings.seed + settings.seeds)
    runs = plan_photo_runs(plan.ladders, plan.methods, quick=settings.quick, seeds=seeds)
    with study_folder(out, KIND, settings):
        shared = PhotoRuns(out, settings.time_limit_s, settings.quick)
        step("rendering the city")
        info = shared.info(settings.seed)
        cells = run_photo_plans(runs, plan.methods, shared, step, settings.chosen_workers)
        step("writing the results")
        study = StressStudy(
            settings=settings,
            scenes=(),
            ladders=(_UNPERTURBED_INFO, *(ladder.info(quick=settings.quick) for ladder in plan.ladders)),
            methods=plan.infos(),
            missing=plan.missing,
            reconstructions=tuple(cells),
            photographs=info,
            provenance=provenance(settings.seed),
        )
        return write_study(out, study, figures=figures, step=step)


def _info(name: str, description: Description) -> MethodInfo:
    """Return the description of a method for results; our own are those of pcbench's version."""
    version = installed_versions(["pcbench"]).get("pcbench", "")
    if description.origin == f"pcbench {version}":
        return MethodInfo(name, RECONSTRUCTION.name, "", "pcbench", version)
    return MethodInfo(name, RECONSTRUCTION.name, "", description.origin, "")
