"""Settings of tiles: what the memory allows, and the least that works."""

import numpy as np
import pytest

from pcbench import Cloud, write_cloud
from pcbench.comparison.plan import choose_tiles
from pcbench.comparison.request import Request, TilingChoice
from pcbench.measure.settings import Settings
from pcbench.measure.tiled.settings import TilingSettings, parse_bytes


def test_tiles_and_pieces_follow_the_memory():
    found = [TilingSettings(memory=parse_bytes(text), workers=2) for text in ("60MB", "700MB", "900MB", "64GB")]
    for sizes in ([s.chosen_piece_points for s in found], [s.chosen_tile_points for s in found]):
        assert sizes[0] == 20_000 < sizes[1] < sizes[2] < sizes[3] == 1_000_000


@pytest.mark.parametrize(("memory", "is_enough"), [("60MB", False), ("1GB", True)])
def test_a_budget_that_is_too_small_is_said_once_with_the_least_that_works(tmp_path, memory, is_enough):
    path, notices = tmp_path / "a.ply", []
    write_cloud(path, Cloud(np.random.default_rng(0).random((1000, 3))))
    tiling = TilingSettings(memory=parse_bytes(memory), workers=1)
    choose_tiles(Request.of(path, path, Settings(), tiles=TilingChoice(tiling)), notices.append)
    assert len(notices) == (0 if is_enough else 1)
    for text in notices:
        least = text.partition("use --memory ")[2]
        raised = TilingSettings(memory=parse_bytes(least), workers=1)
        choose_tiles(Request.of(path, path, Settings(), tiles=TilingChoice(raised)), pytest.fail)


@pytest.mark.parametrize(
    ("workers", "count", "measured_mb"),
    [(1, 300_000, 343), (1, 1_000_000, 397), (1, 3_000_000, 464)],
)
def test_the_least_memory_is_what_was_measured(workers, count, measured_mb):
    """Peaks (PSS) of all processes with too little memory, of two clouds of that many points."""
    in_windows = min(count, 400_000) + min(count, 800_000)
    tiling = TilingSettings(memory=60_000_000, workers=workers)
    assert tiling.least_memory(in_windows, (count, count), 20_000, draws=True) == pytest.approx(
        measured_mb * 1e6, rel=0.15
    )
