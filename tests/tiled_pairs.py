"""Pairs of clouds that are compared in tiles and in memory."""

from dataclasses import replace

import numpy as np
import pytest

from pcbench import compare, read_cloud
from pcbench.comparison.in_tiles import compare_in_tiles
from pcbench.comparison.plan import CloudsOnDisk
from pcbench.comparison.request import Request
from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud
from pcbench.measure.quantities import quantities
from pcbench.measure.settings import Settings
from pcbench.measure.tiled.settings import TILED_PRESETS, TilingSettings

# Sums of other orders round differently; everything else is equal in all bits.
SUMS = ("mse", "mean", "rms", "bias", "std", "chamfer", "sum_", "area_weighted", "budget", "single_directional")


def numbers(candidate):
    """All numbers of a candidate that tiles compute too, by name, and their intervals."""
    return {
        (q.metric, q.direction, q.threshold, q.variant): (q.value, q.interval)
        for q in quantities(candidate)
        if q.variant not in ("mpeg", "tnt") and q.group != "budget"
    }


def is_sum(name):
    return any(part in f"{name[0]}_{name[3]}" for part in SUMS)


def check_equal(tiled, memory, *, with_warnings=True):
    """Check that a comparison in tiles has the numbers of the one in memory."""
    assert replace(tiled.reference, warnings=()) == replace(memory.reference, warnings=())
    assert [a.name for a in tiled] == [b.name for b in memory]
    for ours, theirs in zip(tiled, memory, strict=True):
        assert (ours.points, ours.points_in_region) == (theirs.points, theirs.points_in_region)
        np.testing.assert_array_equal(ours.registration.T_local.matrix, theirs.registration.T_local.matrix)
        found, expected = numbers(ours), numbers(theirs)
        assert found.keys() == expected.keys()
        for name, (value, interval) in expected.items():
            if value is None or isinstance(value, str) or not is_sum(name):
                assert found[name][0] == value or (value != value and found[name][0] != found[name][0]), name
            else:
                # Parts of a budget are differences of sums.
                least = 1e-9 if name[0].startswith("budget") else 0
                assert found[name][0] == pytest.approx(value, rel=1e-12, abs=least), name
            assert (found[name][1] is None) == (interval is None), name
            if interval is not None:
                np.testing.assert_allclose(found[name][1], interval, rtol=1e-8, atol=1e-15, err_msg=str(name))
        assert ours.deformation == theirs.deformation
        if with_warnings:  # in memory, those of reading are not in the result
            assert [w.code for w in ours.warnings] == [w.code for w in theirs.warnings]
        for map_name in ("deviation", "completeness"):
            a, b = getattr(ours, map_name), getattr(theirs, map_name)
            # In memory, the points of the reference are those of its file; in tiles the origin was added again.
            np.testing.assert_allclose(a.points, b.points, rtol=0, atol=1e-15 * (10 + np.abs(b.points).max()))
            np.testing.assert_array_equal(a.rows, b.rows)
            for kind in b.scalars:
                np.testing.assert_array_equal(a.scalars[kind], b.scalars[kind])
    for a, b in zip(tiled.differences, memory.differences, strict=True):
        assert (a.a, a.b, a.metric) == (b.a, b.b, b.metric)
        assert a.difference == pytest.approx(b.difference, rel=1e-9, abs=1e-12)


def compare_on_disk(reference, candidates, settings, tiling, *, workspace, maps=None):
    """Compare files in tiles, without a report."""
    request = Request.of(reference, candidates, settings)
    clouds = CloudsOnDisk.open(request, tiling)
    key = clouds.key(request.settings, tiling)
    return compare_in_tiles(
        clouds, request.settings, tiling, key=key, workspace=workspace, maps=maps, on_step=lambda _: None
    )


class Pair:
    """Files of a reference and of candidates, and their comparison in memory."""

    def __init__(self, folder, reference, *candidates, **settings):
        folder.mkdir(exist_ok=True)
        self.folder, self.paths = folder, {}
        for name, cloud in zip(("ref", "a", "b"), (reference, *candidates), strict=False):
            self.paths[name] = folder / f"{name}.ply"
            write_cloud(self.paths[name], cloud if isinstance(cloud, Cloud) else Cloud(np.asarray(cloud, float)))
        self.settings = Settings(**({"register": "none", "presets": TILED_PRESETS} | settings))

    def tiled(self, work="work", maps=None, settings=None, **tiling):
        workspace = self.folder / work
        workspace.mkdir(exist_ok=True)
        how = TilingSettings(**({"tile_points": 500, "workers": 1} | tiling))
        candidates = {name: path for name, path in self.paths.items() if name != "ref"}
        return compare_on_disk(
            self.paths["ref"], candidates, settings or self.settings, how, workspace=workspace, maps=maps
        )

    def memory(self):
        options = {"classes": self.settings.classes, "returns": self.settings.returns}
        clouds = {name: read_cloud(path, on_warning=lambda _: None, **options) for name, path in self.paths.items()}
        return compare(clouds.pop("ref"), clouds, self.settings)


def surface(rng, count, size=10.0):
    points = rng.random((count, 3)) * size
    points[:, 2] = np.sin(points[:, 0]) + 0.1 * points[:, 1]
    return points


def noisy(rng, points, sigma=0.02):
    return points + rng.normal(size=points.shape) * sigma
