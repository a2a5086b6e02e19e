"""Volumes of changes that are known exactly, and their intervals."""

import numpy as np
import pytest
from volume_cases import CELLS, CHANGES, EXACT_M3, NOISES, Case, Noise, box, cases, cell_sums, cone, run

from pcbench.measure.dem.difference import changed_parts, difference_of
from pcbench.measure.dem.grid import HeightGrid
from pcbench.measure.dem.surface import EpochSurface
from pcbench.measure.dem.volumes import area_change, whole_change

GRID = HeightGrid.over(np.zeros(2), np.full(2, CELLS - 1e-6), 1.0)


def _surface(heights: np.ndarray, variance: float = 1e-4) -> EpochSurface:
    counts = np.where(np.isfinite(heights), 5, 0).astype(np.int32)
    return EpochSurface(heights, np.where(np.isfinite(heights), variance, np.nan), counts)


@pytest.mark.parametrize("change", CHANGES)
def test_exact_volume_without_noise(change) -> None:
    result = difference_of(GRID, _surface(np.zeros((CELLS, CELLS))), _surface(cell_sums(change)))
    whole = whole_change(result)
    # Heights at 8 x 8 places of a cell: the rim of the cone and the edges of the others are cut at 1/8 m.
    assert whole.volumes.net.value == pytest.approx(EXACT_M3[change], rel=0.01, abs=1e-9)
    # Without noise, each changed cell is detected.
    heights = cell_sums(change)
    sides = heights.clip(min=0).sum(), -heights.clip(max=0).sum()
    detected = whole.detected.fill.value, whole.detected.cut.value, whole.detected.net.value
    assert detected == pytest.approx((*sides, sides[0] - sides[1]), abs=1e-9)
    assert whole.by_sign == pytest.approx(sides, abs=1e-9)
    assert whole.mean.value == pytest.approx(heights.mean(), abs=1e-12)
    assert whole.undetected_share == pytest.approx((heights == 0).mean())


def test_without_a_model_of_errors_fill_and_cut_are_sums_by_sign() -> None:
    heights = np.zeros((9, 9))
    heights[:6], heights[6:] = 2.0, -1.0
    grid = HeightGrid.over(np.zeros(2), np.full(2, 9 - 1e-6), 1.0)
    result = difference_of(grid, _surface(np.zeros((9, 9))), _surface(heights))
    whole = whole_change(result)
    assert result.model is None
    assert not result.parts.any()
    assert (whole.volumes.fill.value, whole.volumes.cut.value, whole.volumes.net.value) == (108, 27, 81)
    assert np.isnan(whole.volumes.net.low)


@pytest.mark.parametrize("seed", range(20))
def test_errors_alone_make_no_part(seed: int) -> None:
    noise = np.random.default_rng(seed).standard_normal((CELLS, CELLS))
    assert not changed_parts(noise, np.ones_like(noise)).any()


def test_parts_of_a_cone_and_of_a_box_and_a_pit() -> None:
    case = Case("plane", Noise())
    # The rim of the cone, which is lower than the errors of its cells, is not all in the part.
    assert run(case, cone, 1).true["part"] == pytest.approx(EXACT_M3[cone], rel=0.05)
    noise = 0.03 * np.random.default_rng(0).standard_normal((CELLS, CELLS))
    parts = changed_parts(cell_sums(box) + noise, np.full(noise.shape, 0.03))
    assert parts.max() == 2
    assert (parts[cell_sums(box) < 0] == 1).all() and (parts[cell_sums(box) > 0] == 2).all()


def test_offset_of_named_stable_terrain_is_subtracted_with_its_error() -> None:
    rng = np.random.default_rng(4)
    stable = np.zeros((CELLS, CELLS), dtype=bool)
    stable[:, :20] = True
    dz = 0.1 + 0.01 * rng.standard_normal(stable.shape)
    result = difference_of(GRID, _surface(np.zeros_like(dz)), _surface(dz), named_stable=stable)
    assert result.offset == pytest.approx(dz[stable].mean())
    zone = np.zeros_like(stable)
    zone[10:20, 30:40] = True
    sums = result.sum_weights(zone.astype(float))
    assert sums.white == pytest.approx(2e-4 * (100 + 100**2 / 1200), rel=0.3)  # by slope and density within a quarter
    assert abs(area_change(result, "", stable).volumes.net.value) < 1e-9


def test_voids_are_left_out_or_filled_from_their_neighbours() -> None:
    after = np.full((CELLS, CELLS), 0.5)
    after[30, 30], after[40:55, 40:55] = np.nan, np.nan
    left_out = area_change(difference_of(GRID, _surface(np.zeros_like(after)), _surface(after)), "", after == after)
    assert left_out.area == CELLS**2 - 226
    result = difference_of(GRID, _surface(np.zeros_like(after)), _surface(after), is_filled=True)
    assert result.filled[30, 30] and result.dz[30, 30] == pytest.approx(0.5)
    assert np.isnan(result.dz[47, 47])  # more than five cells from any other


@pytest.mark.slow
def test_intervals_cover() -> None:
    held: list[bool] = []
    chosen = [
        (name, case) for name, case in cases(("plane", "ramp", "hills", "rough")) if name.split(", ")[1] in NOISES
    ]
    for number, (_, case) in enumerate(chosen):
        for at, change in enumerate(CHANGES):
            result = run(case, change, 1000 * number + at)
            held += [m.low <= result.true[kind] <= m.high for kind, m in result.measured.items() if kind != "part"]
    # All kinds of errors together: 120 runs of four volumes, which depend on each other: standard error 1 %.
    assert 0.92 <= np.mean(held) <= 0.99


@pytest.mark.parametrize("share", [0.1, 0.5, 0.7, 1.0])
def test_a_larger_change_is_never_reported_less(share: float) -> None:
    """A change of any extent from 20 times the noise on is one part, whose volume grows with its height."""
    side = 40
    raised = np.zeros((side, side))
    raised[:, : round(share * side)] = 1.0
    rng = np.random.default_rng(3)
    noise = 0.05 * rng.standard_normal((2, side, side))
    grid = HeightGrid.over(np.zeros(2), np.full(2, side - 1e-6), 1.0)
    for height in (1.0, 30.0, 300.0):
        result = difference_of(grid, _surface(noise[0]), _surface(noise[1] + height * raised))
        net = whole_change(result).volumes.net
        assert result.parts.max() == 1
        assert net.low < height * raised.sum() < net.high
        assert net.low > 0.9 * height * raised.sum()  # the noise of a cell is a twentieth of the smallest height
