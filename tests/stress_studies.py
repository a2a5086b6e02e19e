"""Stress studies with known counts, built by hand."""

from dataclasses import replace

from pcbench.studies.stress.changes import ChangeCell
from pcbench.studies.stress.descriptions import LadderInfo, MethodInfo, MissingMethod, SceneInfo
from pcbench.studies.stress.metrics import MetricCell
from pcbench.studies.stress.registration import RegistrationCell
from pcbench.studies.stress.results import StressSettings, StressStudy
from pcbench.studies.stress.subject import (
    CRASH,
    FALSE_ALARM,
    GLOBAL,
    LOCAL,
    REFUSED,
    RIGHT,
    SAID,
    SILENT,
    TIME_OUT,
    UNNAMED,
    WITHHELD,
    WRONG,
)
from pcbench.studies.stress.verdicts import FALSE_BEND, MISSED, WITHHELD_ALTHOUGH_RIGHT, VerdictCell

ROTATION = LadderInfo("start-rotation", "rotation of the start", "start", ("registration",), "deg", (0, 15, 45, 90))
OVERLAP = LadderInfo("overlap", "overlap", "parts", ("registration", "verdicts"), "%", (100, 60, 20))
MAP = LadderInfo(
    "start-map", "rotation of the start", "start", ("registration",), "deg", (0, 20, 45),
    second_title="offset of the start", second_unit="% of the extent", second_levels=(0, 5, 20),
)  # fmt: skip
CASES = LadderInfo(
    "degenerate", "degenerate surface", "degenerate", ("registration",), "", (0, 1), ("plane", "half-turn building")
)
GAUSSIAN = LadderInfo(
    "noise-gaussian", "Gaussian noise", "noise", ("registration", "metrics", "verdicts"), "spacings", (0, 1, 4)
)  # fmt: skip
DOME = LadderInfo("warp-dome", "dome", "warp", ("verdicts",), "x noise", (0, 1, 4))
PART = LadderInfo("raised-part", "raised part", "changes", ("changes",), "x noise", (0, 10, 100))
LADDERS = (ROTATION, MAP, OVERLAP, GAUSSIAN, DOME, PART, CASES)

ICP = MethodInfo("icp", "registration", LOCAL, "pcbench", "1")
PEER = MethodInfo("peer", "registration", LOCAL, "peerlib", "2")
ANYWHERE = MethodInfo("global", "registration", GLOBAL, "pcbench", "1")
METRIC = MethodInfo("pcbench", "metrics", "", "pcbench", "1")
PEER_METRIC = MethodInfo("Open3D", "metrics", "", "open3d", "0.19")
DEFORM = MethodInfo("deform", "verdicts", "", "pcbench", "1")
NAIVE = MethodInfo("naive BIC", "verdicts", "", "naive", "1")
NAMING = MethodInfo("changes", "changes", "", "pcbench", "1")
CITY = SceneInfo("city", 200.0, 0.5, 0.03, "m", (40_000, 20_000))

_ERRORS = {RIGHT: 0.001, FALSE_ALARM: 0.0008, SAID: 0.6, SILENT: 0.9}


def registrations(ladder, level, method, outcomes, second=None):
    """Registration cells of a level, with consecutive seeds; errors follow from the outcomes."""
    rows = []
    for seed, outcome in enumerate(outcomes):
        error = _ERRORS.get(outcome)
        size = {} if error is None else {
            "error": error * (1 + 0.3 * seed), "error_rms": 100 * error, "angle_error_deg": 60 * error,
            "offset_error": 40 * error,
        }  # fmt: skip
        crashed = outcome in (CRASH, TIME_OUT)
        rows.append(RegistrationCell(
            "city", ladder.name, level, second, method, seed, outcome, cpu_s=None if crashed else 0.5 + 0.1 * seed,
            memory_bytes=None if crashed else 50 * 2**20, tolerance=0.5, start_error=0.4,
            doubtful=outcome in (FALSE_ALARM, SAID, REFUSED), **size,
        ))  # fmt: skip
    return rows


def metrics(level, method, metric, outcomes, covers=None):
    """Metric cells of a level of Gaussian noise; `covers` lists whether each interval contains the exact value."""
    value = {RIGHT: 1.05, SAID: 1.3, SILENT: 2.0}
    return [
        MetricCell(
            "city", GAUSSIAN.name, level, None, method, seed, outcome, cpu_s=0.2, metric=metric,
            value=value.get(outcome), exact=1.0,
            interval=None if covers is None else (0.9, 1.1) if covers[seed] else (1.01, 1.2),
        )
        for seed, outcome in enumerate(outcomes)
    ]  # fmt: skip


def verdicts(ladder, level, method, results, true_rms=0.0, covers=None):
    """Verdict cells of a level; each result is an outcome and a failure."""
    rows = []
    for seed, (outcome, failure) in enumerate(results):
        bent = outcome == RIGHT if true_rms > 0 else outcome == WRONG
        size = {"verdict": "undecided" if outcome == WITHHELD else "non-affine" if bent else "none"}
        if outcome == RIGHT and true_rms > 0:
            size["rms"] = 1.1 * true_rms
            if covers is not None:
                size["interval"] = ((0.9 if covers[seed] else 1.05) * true_rms, 1.2 * true_rms)
        rows.append(VerdictCell(
            "city", ladder.name, level, None, method, seed, outcome, cpu_s=1.0, failure=failure, true_rms=true_rms,
            noise=0.04, **size,
        ))  # fmt: skip
    return rows


def searches(level, outcomes):
    """Change cells of a level of the raised part; wrong ones are of another kind, or at a place without a change."""
    rows = []
    for seed, outcome in enumerate(outcomes):
        is_named = outcome != UNNAMED and level > 0
        rows.append(ChangeCell(
            "city", PART.name, level, None, "changes", seed, outcome, cpu_s=0.8, noise=0.04,
            kinds=("moved",) if level else (), points=60 if level else 0, true_size=0.04 * level if level else None,
            named=(("added",) if outcome == WRONG else ("moved",)) if is_named else (),
            elsewhere=int(outcome == WRONG and level == 0), size=0.041 * level if is_named else None,
        ))  # fmt: skip
    return rows


def crowded_study():
    """The study with ten more local methods and four more metrics, all as bad as the peers."""
    made = study()
    methods = [MethodInfo(f"another method {k}", "registration", LOCAL, "peerlib", "2") for k in range(10)]
    meters = [MethodInfo(f"another library {k}", "metrics", "", "peerlib", "2") for k in range(4)]
    peers = [cell for cell in made.registrations if cell.method == "peer"]
    values = [cell for cell in made.metrics if cell.method == "Open3D"]
    return study(
        methods=(*made.methods, *methods, *meters),
        registrations=(*made.registrations, *(replace(c, method=m.name) for m in methods for c in peers)),
        metrics=(*made.metrics, *(replace(c, method=m.name) for m in meters for c in values)),
    )


def study(**changes):
    """A study with all subjects.

    `icp` has 12 runs of rotation (right at 0 and 15 deg; beyond: 4 said, 1 silent, 1 false alarm), 9 of overlap (right
    down to 60 %, then 2 refused and a time-out), 18 of the map (right up to 20 deg and 5 %), 6 of Gaussian noise (all
    right) and 4 of cases. `peer` has the same runs with more silent failures, `global` those of overlap and noise.
    """
    cells = []
    for method, at_45, at_90 in (("icp", [FALSE_ALARM, SAID, SAID], [SAID, SAID, SILENT]),
                                 ("peer", [SILENT, SILENT, SAID], [SILENT, SILENT, SILENT])):  # fmt: skip
        for level, outcomes in zip(ROTATION.levels, ([RIGHT] * 3, [RIGHT] * 3, at_45, at_90), strict=True):
            cells += registrations(ROTATION, level, method, outcomes)
        for level in MAP.levels:
            for second in MAP.second_levels:
                good = level <= 20 and second <= 5
                cells += registrations(MAP, level, method, [RIGHT if good else SAID] * 2, second)
        cells += registrations(CASES, 0, method, [SAID, SAID])
        cells += registrations(CASES, 1, method, [RIGHT, SILENT])
    for method in ("icp", "peer", "global"):
        cells += registrations(OVERLAP, 100, method, [RIGHT] * 3)
        cells += registrations(OVERLAP, 60, method, [RIGHT] * 3)
        cells += registrations(OVERLAP, 20, method, [REFUSED, REFUSED, TIME_OUT])
        for level in GAUSSIAN.levels:
            cells += registrations(GAUSSIAN, level, method, [RIGHT] * 2)
    measured = []
    for level, ours, theirs in ((0, [RIGHT] * 4, [SILENT] * 4), (1, [RIGHT] * 4, [SILENT] * 4),
                                (4, [RIGHT, SAID, SAID, SILENT], [RIGHT] * 4)):  # fmt: skip
        measured += metrics(level, "pcbench", "RMS off the surface", ours, [True, True, True, level < 4])
        measured += metrics(level, "Open3D", "RMS off the surface", theirs)
    decided = [
        *verdicts(DOME, 0, "deform", [(RIGHT, "")] * 3 + [(WITHHELD, WITHHELD_ALTHOUGH_RIGHT)]),
        *verdicts(DOME, 1, "deform", [(RIGHT, "")] * 3 + [(WRONG, MISSED)], 0.04, [True, True, False, True]),
        *verdicts(DOME, 4, "deform", [(RIGHT, "")] * 4, 0.16, [True] * 4),
        *verdicts(DOME, 0, "naive BIC", [(WRONG, FALSE_BEND)] * 3 + [(RIGHT, "")]),
        *verdicts(DOME, 1, "naive BIC", [(RIGHT, "")] * 4, 0.04),
        *verdicts(DOME, 4, "naive BIC", [(RIGHT, "")] * 4, 0.16),
    ]
    values = {
        "settings": StressSettings(),
        "scenes": (CITY,),
        "ladders": LADDERS,
        "methods": (PEER, ICP, ANYWHERE, PEER_METRIC, METRIC, DEFORM, NAIVE, NAMING),
        "missing": (MissingMethod("KISS-Matcher", "kiss-matcher is not installed: pip install 'pcbench[global]'"),),
        "registrations": tuple(cells),
        "metrics": tuple(measured),
        "verdicts": tuple(decided),
        "changes": (
            *searches(0, [RIGHT] * 5 + [WRONG]),
            *searches(10, [RIGHT] * 3 + [UNNAMED]),
            *searches(100, [RIGHT] * 3 + [WRONG]),
        ),
    }
    return StressStudy(**{**values, **changes})
