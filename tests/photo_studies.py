"""Studies of reconstructors with known scores, built by hand."""

from pcbench.studies.stress.descriptions import LadderInfo, MethodInfo, MissingMethod, PhotographInfo
from pcbench.studies.stress.reconstructors.ladders import PHOTO_LADDERS
from pcbench.studies.stress.reconstructors.reconstruction import UNPERTURBED, ReconstructionCell, settle
from pcbench.studies.stress.results import StressSettings, StressStudy
from pcbench.studies.stress.subject import CRASH, REFUSED, RIGHT, TIME_OUT

METHODS = tuple(MethodInfo(name, "reconstruction", "", "pcbench", "1") for name in ("sfm", "mvs"))
INFO = PhotographInfo(10, (160, 120), "oblique", 100.0, 1.2, 2.4, 100_000)
FAILURES = (REFUSED, CRASH, TIME_OUT)
WARNING = "warning: most pairs contradict the cameras"
# For each method and ladder one entry per level: an F-score, an F-score with a warning, or a failure.
SCORES = {
    "sfm": {
        UNPERTURBED: [0.2],
        "fewer-images": [0.18, 0.12, REFUSED, REFUSED, REFUSED],
        "blur": [0.2, 0.15, 0.05, CRASH, REFUSED],
        "difficult": [0.1, 0.15, 0.15, REFUSED, 0.02],
    },
    "mvs": {
        UNPERTURBED: [0.96],
        "fewer-images": [0.9, 0.8, 0.7, 0.6, 0.5],
        "blur": [(0.4, WARNING), (0.9, WARNING), 0.3, TIME_OUT, REFUSED],
        "difficult": [0.9, 0.8, 0.7, (0.1, WARNING), 0.3],
    },
}
MESSAGES = {REFUSED: "too few features: take sharper images; or fewer", CRASH: "SIGABRT", TIME_OUT: ""}


def ladder_infos():
    start = LadderInfo(UNPERTURBED, UNPERTURBED, UNPERTURBED, ("reconstruction",), "", (0.0,), (UNPERTURBED,))
    return (start, *(PHOTO_LADDERS[name].info(quick=False) for name in ("fewer-images", "blur", "difficult")))


def reconstructions(method, ladder, level, entry, seed=0):
    """Return the cell of an entry of `SCORES`."""
    if entry in FAILURES:
        return ReconstructionCell(
            "photographs", ladder, level, None, method, seed, entry, message=MESSAGES[entry], cpu_s=1.5, images=10
        )
    fscore, *notes = entry if isinstance(entry, tuple) else (entry,)
    return ReconstructionCell(
        "photographs", ladder, level, None, method, seed, RIGHT, cpu_s=4.0, memory_bytes=100 * 2**20, fscore=fscore,
        precision=0.9, recall=0.8, threshold=2.4, rms=1 - 0.8 * fscore, points=1000, cameras=10, images=10,
        registration="none", notes=("10 images matched", *notes), wall_s=3.0,
    )  # fmt: skip


def photo_study(scores=SCORES, **changes):
    """Return a study with the given scores and one seed."""
    infos = ladder_infos()
    cells = [
        reconstructions(method, ladder.name, level, entry)
        for method, by_ladder in scores.items()
        for ladder in infos
        if ladder.name in by_ladder
        for level, entry in zip(ladder.levels, by_ladder[ladder.name], strict=True)
    ]
    values = {
        "settings": StressSettings(reconstructors=True),
        "scenes": (),
        "ladders": tuple(info for info in infos if any(info.name in by for by in scores.values())),
        "methods": METHODS,
        "missing": (MissingMethod("splat", "torch is not installed: pip install 'pcbench[splat]'"),),
        "reconstructions": tuple(settle(cells)),
        "photographs": INFO,
    }
    return StressStudy(**{**values, **changes})
