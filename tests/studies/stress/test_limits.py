"""Safe levels of ladders and maps."""

import pytest
from stress_studies import MAP, OVERLAP, ROTATION, registrations, study

from pcbench.studies.stress.limits import safe_ranges, safe_starts, stress_rows
from pcbench.studies.stress.metrics import METRICS
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.subject import FALSE_ALARM, RIGHT, SAID, SILENT
from pcbench.studies.stress.verdicts import VERDICTS


def limit(ladder, levels):
    """Safe range of the outcomes of each level of a ladder."""
    cells = [c for level, outcomes in zip(ladder.levels, levels, strict=True)
             for c in registrations(ladder, level, "icp", outcomes)]  # fmt: skip
    made = study(registrations=tuple(cells))
    (row,) = stress_rows(made, REGISTRATION)
    (found,) = safe_ranges(made, row)
    return found


def test_the_safe_range_ends_before_the_first_level_that_fails():
    found = limit(ROTATION, [[RIGHT] * 4, [RIGHT] * 4, [SAID] * 4, [RIGHT] * 4])
    assert found.level == 15  # the last level does not count, although it succeeds
    assert {cell.level for cell in found.beyond} == {45, 90} and len(found.beyond) == 8
    assert not found.is_complete


def test_one_silent_failure_ends_a_safe_range_and_one_said_failure_of_ten_does_not():
    assert limit(OVERLAP, [[RIGHT] * 10, [RIGHT] * 9 + [SAID], [RIGHT] * 8 + [SAID] * 2]).level == 60
    assert limit(OVERLAP, [[RIGHT] * 10, [RIGHT] * 9 + [SILENT], [RIGHT] * 10]).level == 100


def test_doubted_right_poses_are_safe():
    found = limit(OVERLAP, [[RIGHT] * 3, [FALSE_ALARM] * 3, [RIGHT] * 3])
    assert found.is_complete
    assert found.beyond == ()


def test_a_ladder_may_have_no_safe_level():
    found = limit(OVERLAP, [[SAID] * 3, [RIGHT] * 3, [RIGHT] * 3])
    assert found.level is None
    assert len(found.beyond) == 9


@pytest.mark.parametrize(
    ("safe", "expected"),
    [
        ({(0, 0), (0, 5), (20, 0), (20, 5), (45, 20)}, (20, 5)),
        ({(0, 0), (0, 5), (0, 20), (20, 0)}, (0, 20)),
        ({(0, 0), (20, 0), (45, 0), (0, 5)}, (45, 0)),
        ({(0, 5), (20, 5)}, (None, None)),
    ],
)
def test_the_safe_start_is_the_largest_rectangle_from_the_easiest_corner(safe, expected):
    places = [(level, second) for level in MAP.levels for second in MAP.second_levels]
    outcomes = {place: RIGHT if place in safe else SAID for place in places}
    cells = [c for place in places for c in registrations(MAP, place[0], "icp", [outcomes[place]], place[1])]
    made = study(registrations=tuple(cells))
    (row,) = stress_rows(made, REGISTRATION)
    (found,) = safe_starts(made, row)
    assert (found.level, found.second) == expected


def test_rows_are_ours_first_and_one_per_metric():
    made = study()
    assert [row.name for row in stress_rows(made, REGISTRATION)] == ["icp", "global", "peer"]
    names = ["pcbench, RMS off the surface", "Open3D, RMS off the surface"]
    assert [row.name for row in stress_rows(made, METRICS)] == names
    assert [len(row.cells) for row in stress_rows(made, VERDICTS)] == [12, 12]


def test_lists_and_maps_have_no_safe_range():
    made = study()
    names = {found.ladder.name for found in safe_ranges(made, stress_rows(made, REGISTRATION)[0])}
    assert names == {"start-rotation", "overlap", "noise-gaussian"}
