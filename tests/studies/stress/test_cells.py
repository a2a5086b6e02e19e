"""Cells of the stress study: outcomes of registrations, metrics and verdicts against the truth."""

from dataclasses import replace

import numpy as np
import pytest

from pcbench.changes import ADDED, MOVED
from pcbench.deformation import Deformation
from pcbench.deformation.parts import ModelScore
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.transform import Similarity
from pcbench.studies.stress import cells, metrics, verdicts
from pcbench.studies.stress.cells import RunPlan, build_pair, failed_run, plan_runs, run_cell
from pcbench.studies.stress.changes import CHANGE_METHODS, NamedChange
from pcbench.studies.stress.ladders import LADDERS
from pcbench.studies.stress.ladders.ladder import rotation
from pcbench.studies.stress.methods import METHODS, PoseResult
from pcbench.studies.stress.registration import RegistrationCell, settle_refusals
from pcbench.studies.stress.subject import (
    CRASH,
    FALSE_ALARM,
    GLOBAL,
    LOCAL,
    REFUSED,
    RIGHT,
    SAID,
    SILENT,
    UNNAMED,
    WITHHELD,
    WRONG,
    StressMethod,
)
from pcbench.studies.stress.verdicts import FALSE_BEND, MISSED, WITHHELD_ALTHOUGH_RIGHT

DIGITS = 1e-5  # relative: results are rounded to six digits
PLAN = RunPlan("registration", "city", "overlap", 100.0, None, "icp", 0, 3000)


@pytest.fixture(scope="module")
def pair():
    return build_pair(PLAN)


def outcome_of(monkeypatch, pair, result, plan=PLAN):
    monkeypatch.setitem(METHODS, "icp", StressMethod("icp", lambda *_: result, scope=LOCAL))
    (cell,) = run_cell(plan, pair).cells
    return cell


def test_outcomes_of_poses(monkeypatch, pair):
    right, wrong = pair.T_true, Similarity(np.eye(3), [0, 0, 2 * pair.spacing]) @ pair.T_true
    for pose, doubtful, outcome in (
        (right, False, RIGHT),
        (right, True, FALSE_ALARM),
        (wrong, False, SILENT),
        (wrong, True, SAID),
        (None, True, REFUSED),
    ):
        assert outcome_of(monkeypatch, pair, PoseResult(pose, doubtful)).outcome == outcome
    warned = outcome_of(monkeypatch, pair, PoseResult(right, False, ("low-overlap",)))
    assert warned.outcome == RIGHT and warned.warned and warned.codes == ("low-overlap",)


def test_a_slip_along_a_free_motion_is_said_by_naming_it(monkeypatch, pair):
    wrong = Similarity(np.eye(3), [9.0, 0, 0]) @ pair.T_true
    named = PoseResult(wrong, False, ("unobservable",))
    assert outcome_of(monkeypatch, pair, named).outcome == SILENT
    assert outcome_of(monkeypatch, replace(pair, free=True), named).outcome == SAID
    assert outcome_of(monkeypatch, replace(pair, free=True), PoseResult(wrong)).outcome == SILENT
    assert outcome_of(monkeypatch, replace(pair, free=True), PoseResult(None)).outcome == SAID


def test_a_wrong_scale_is_said_by_naming_it(monkeypatch, pair):
    wrong = Similarity(np.eye(3), np.zeros(3), 1.2) @ pair.T_true
    named = PoseResult(wrong, False, ("scale-missing",))
    assert outcome_of(monkeypatch, pair, named).outcome == SILENT  # the scales are equal
    scaled = LADDERS["scale"].apply(pair, 1.05, None, np.random.default_rng(0))
    assert outcome_of(monkeypatch, scaled, named).outcome == SAID
    assert outcome_of(monkeypatch, scaled, PoseResult(wrong, False, ("low-overlap",))).outcome == SILENT


def test_errors_of_a_known_displacement(monkeypatch, pair):
    centre = pair.points.mean(axis=0)
    turn = Similarity(rotation(np.array([0, 0, 1.0]), np.radians(10)), np.zeros(3)).about(centre)
    cell = outcome_of(monkeypatch, pair, PoseResult(turn @ pair.T_true))
    # A rotation by a moves a point at the distance r from the axis by 2 r sin(a / 2).
    planar = np.linalg.norm((pair.points - centre)[:, :2], axis=1)
    moved = 2 * planar * np.sin(np.radians(5))
    assert cell.error == pytest.approx((moved / np.linalg.norm(pair.points - centre, axis=1)).mean(), rel=1e-3)
    assert cell.error_rms == pytest.approx(np.sqrt(np.mean(moved**2)), rel=DIGITS)
    assert cell.angle_error_deg == pytest.approx(10, rel=DIGITS) and cell.offset_error == pytest.approx(0, abs=1e-9)
    assert cell.tolerance == pytest.approx(pair.spacing, rel=DIGITS) and cell.start_error > 0.01
    shifted = outcome_of(monkeypatch, pair, PoseResult(Similarity(np.eye(3), [3.0, 4.0, 0]) @ pair.T_true))
    assert shifted.offset_error == pytest.approx(5, rel=DIGITS) and shifted.angle_error_deg == pytest.approx(
        0, abs=1e-6
    )


def test_an_exception_is_a_crash(monkeypatch, pair):
    def fail(*_):
        raise ZeroDivisionError("division\nby zero")

    monkeypatch.setitem(METHODS, "icp", StressMethod("icp", fail, scope=LOCAL))
    (cell,) = run_cell(PLAN, pair).cells
    assert (cell.outcome, cell.message, cell.cpu_s) == (CRASH, "ZeroDivisionError: division by zero", None)
    for plan, count in ((replace(PLAN, subject="metrics"), 2), (replace(PLAN, subject="verdicts"), 3)):
        assert [cell.outcome for cell in failed_run(plan, CRASH, "x").cells] == [CRASH] * count


def test_refusals_count_where_the_pose_was_findable():
    def cell(method, outcome, level=10.0, ladder="overlap"):
        return RegistrationCell("city", ladder, level, None, method, 0, outcome)

    def settled(*group):
        return [found.outcome for found in settle_refusals(group)]

    assert METHODS["icp"].scope == LOCAL and METHODS["global"].scope == GLOBAL
    assert settled(cell("icp", REFUSED), cell("similarity", RIGHT)) == [REFUSED, RIGHT]
    assert settled(cell("icp", REFUSED), cell("similarity", SILENT)) == [SAID, SILENT]
    assert settled(cell("icp", REFUSED), cell("global", RIGHT)) == [SAID, RIGHT]
    assert settled(cell("global", REFUSED), cell("icp", FALSE_ALARM)) == [REFUSED, FALSE_ALARM]
    assert settled(cell("icp", REFUSED), cell("similarity", RIGHT, level=5.0)) == [SAID, RIGHT]


def test_a_registration_of_ours_is_right_and_costs_are_recorded(pair):
    result = run_cell(PLAN, pair)
    (cell,) = result.cells
    assert cell.outcome == RIGHT and cell.cpu_s > 0
    found = Similarity.from_matrix(result.pose).apply(pair.candidate)
    assert np.sqrt(np.square(found - pair.points).sum(axis=1).mean()) == pytest.approx(cell.error_rms, rel=DIGITS)
    assert cell.error_rms < 0.3 * pair.spacing


def test_metrics_are_judged_by_the_exact_surface():
    plan = replace(PLAN, subject="metrics", ladder="noise-gaussian", level=4.0, method="pcbench")
    pair = build_pair(plan)
    mean, rms = run_cell(plan, pair).cells
    assert (mean.metric, rms.metric) == metrics.NAMES
    distances = MeshIndex(pair.surface).query(pair.points).distances
    assert rms.exact == pytest.approx(np.sqrt(np.mean(distances**2)), rel=DIGITS)
    assert mean.exact == pytest.approx(distances.mean(), rel=DIGITS)
    assert 0.5 * pair.candidate_noise < rms.exact < pair.candidate_noise  # other surfaces may be closer
    assert rms.outcome == RIGHT and rms.interval[0] < rms.exact < rms.interval[1]
    assert mean.value > mean.exact and mean.floor > 0


@pytest.mark.parametrize(
    "value, floor, interval, outcome",
    [
        (1.09, None, None, RIGHT),
        (1.2, None, None, SILENT),
        (1.2, None, (0.9, 1.5), SAID),
        (1.2, 0.3, (1.1, 1.3), SAID),
        (1.2, 0.05, (1.1, 1.3), SILENT),
        (0.5, 0.6, (0.4, 0.6), SILENT),
        (None, None, None, SAID),
    ],
)
def test_outcomes_of_metrics(value, floor, interval, outcome):
    assert metrics.outcome_of(metrics.MeasuredValue(value, floor, interval), 1.0) == outcome


@pytest.mark.parametrize(
    "verdict, limit, true_rms, pose_is_right, expected",
    [
        ("none", 0.1, 0.0, True, (RIGHT, "")),
        ("none", 1.0, 0.5, True, (RIGHT, "")),  # below the stated limit
        ("none", 0.4, 0.5, True, (WRONG, MISSED)),
        ("none", None, 0.5, True, (WRONG, MISSED)),
        ("affine", None, 0.2, True, (RIGHT, "")),  # too small to count
        ("non-affine", 0.1, 0.5, True, (RIGHT, "")),
        ("non-affine", 0.1, 0.2, True, (RIGHT, "")),
        ("non-affine", 0.1, 0.0, True, (WRONG, FALSE_BEND)),
        ("undecided", None, 0.5, True, (WITHHELD, WITHHELD_ALTHOUGH_RIGHT)),
        ("undecided", None, 0.5, False, (WITHHELD, "")),
    ],
)
def test_outcomes_of_verdicts(verdict, limit, true_rms, pose_is_right, expected):
    values = verdicts.VerdictValues(verdict, limit=limit)
    assert verdicts.outcome_of(values, true_rms, 1.0, pose_is_right=pose_is_right) == expected


def test_naive_rules_choose_by_their_own_scores():
    def found(explained, cv):
        rungs = tuple(
            ModelScore(model, parameters, score, 0.0, 0.0, rms)
            for (model, parameters), score, rms in zip(
                (("rigid", 6), ("similarity", 7), ("affine", 12), ("quadratic", 30), ("cubic", 60)),
                cv,
                explained,
                strict=True,
            )
        )
        return Deformation("none", "rigid", rungs=rungs, remaining_rms=1.0, pairs=10_000)

    # A share of 1 % of the squared residuals is worth 100 in N ln(mse), less than 24 ln(N) = 221; one of 4 % is not.
    weak, strong = (found((0, 0, 0, size, size), (5, 4, 3, 1, 2)) for size in (0.1, 0.2))
    bic, tiles = verdicts.VERDICT_METHODS[verdicts.NAIVE_BIC], verdicts.VERDICT_METHODS[verdicts.NAIVE_TILES]
    assert bic.run(weak).verdict == "none"
    assert (bic.run(strong).verdict, bic.run(strong).rms) == ("non-affine", pytest.approx(0.2))
    assert tiles.run(weak).verdict == "non-affine"
    assert tiles.run(found((0,) * 5, (5, 4, 3, 6, 6))).verdict == "affine"
    assert bic.run(Deformation("undecided", "rigid")).verdict == "undecided"


def test_verdicts_on_a_known_dome():
    plan = RunPlan("verdicts", "city", "warp-dome", 4.0, None, "deform", 0, 8000)
    ours, bic, tiles = run_cell(plan, build_pair(plan)).cells
    assert [cell.method for cell in (ours, bic, tiles)] == list(verdicts.VERDICT_METHODS)
    assert (ours.verdict, ours.outcome, ours.pose_is_right) == ("non-affine", RIGHT, True)
    assert ours.size_in_noise == pytest.approx(4, rel=DIGITS) and ours.ratio == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize(
    ("level", "kinds", "elsewhere", "outcome"),
    [
        (0, [], False, RIGHT),
        (0, [], True, WRONG),
        (100, [MOVED], False, RIGHT),
        (100, [MOVED], True, WRONG),
        (100, [ADDED], False, WRONG),
        (100, [], False, UNNAMED),
        (3, [], False, RIGHT),  # so small a motion may be named or not
        (3, [MOVED], False, RIGHT),
    ],
)
def test_outcomes_of_changes(level, kinds, elsewhere, outcome, monkeypatch):
    plan = RunPlan("changes", "terrain", "raised-part", level, None, "changes", 0, 6000)
    changed = build_pair(plan)
    true = changed.change
    found = [NamedChange(kind, true.size, true.points[:20]) for kind in kinds]
    if elsewhere:
        place = np.zeros(3) if true is None else true.points.mean(axis=0)
        far = np.argsort(np.linalg.norm(changed.points - place, axis=1))[-30:]
        found.append(NamedChange(MOVED, 1.0, changed.points[far]))
    monkeypatch.setitem(CHANGE_METHODS, "changes", StressMethod("changes", lambda _: found))
    (cell,) = run_cell(plan, changed).cells
    assert cell.outcome == outcome and cell.named == tuple(kinds) and cell.elsewhere == elsewhere
    assert cell.has_to_be_named == (level == 100)


def test_a_raised_part_is_named():
    plan = RunPlan("changes", "terrain", "raised-part", 100, None, "changes", 0, 24_000)
    (cell,) = run_cell(plan, build_pair(plan)).cells
    assert cell.outcome == RIGHT and cell.named[0] == MOVED
    assert cell.size == pytest.approx(cell.true_size, rel=0.25)


def test_plan_runs_each_subject_once(pair):
    ladders = [LADDERS[name] for name in ("start-map", "density", "degenerate", "missing-vegetation")]
    methods = {"registration": ("icp", "global"), "metrics": ("pcbench",), "verdicts": ("deform",)}
    arguments = {"quick": True, "seeds": range(2), "points": 100}
    runs = list(plan_runs(ladders, methods, **arguments, given=None))
    assert len(set(runs)) == len(runs)
    assert sum(run.ladder == "start-map" for run in runs) == 9 * 2  # without global methods
    assert sum(run.subject == "registration" and run.ladder == "density" for run in runs) == 2 * 2 * 2
    assert {run.scene for run in runs if run.ladder == "degenerate"} == {"shapes"}
    given = list(plan_runs(ladders, methods, **arguments, given=pair))
    assert {(run.subject, run.scene) for run in given} == {("registration", "given")}
    assert {run.ladder for run in given} == {"start-map", "density"}
    full = plan_runs(ladders, methods, quick=False, seeds=range(1), points=100, given=None)
    assert {run.scene for run in full} == {"city", "terrain", "room", "object", "shapes", "wooded city"}


def test_a_pair_depends_on_seed_and_level_alone(pair):
    again = build_pair(replace(PLAN, method="similarity"))
    np.testing.assert_array_equal(again.candidate, pair.candidate)
    assert not np.array_equal(build_pair(replace(PLAN, seed=1)).candidate, pair.candidate)
    near, far = (build_pair(replace(PLAN, ladder="noise-gaussian", level=level)) for level in (0.5, 1.0))
    np.testing.assert_allclose((far.points - pair.points), 2 * (near.points - pair.points), atol=1e-9)
    assert cells.build_pair(PLAN).extent == pair.extent
