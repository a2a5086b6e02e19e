"""Thinning: shares, reproducible seeds, and Poisson disks against a loop over all points."""

import numpy as np
import pytest
import shapes
from scipy.spatial import cKDTree
from wording import check_error

from pcbench.geometry import thinning
from pcbench.geometry.thinning import disk_radius_for, thin_at_random, thin_by_disks, voxel_side_for
from pcbench.geometry.voxels import voxel_downsample


def darts(points, radius, seed):
    """Throw darts one after the other: the order of the random ranks."""
    rank = np.random.default_rng(seed).permutation(len(points))
    kept = []
    for row in np.argsort(rank):
        if not kept or np.linalg.norm(points[kept] - points[row], axis=1).min() > radius:
            kept.append(row)
    return np.sort(kept)


def test_random_thinning_keeps_the_share_and_follows_the_seed():
    points = shapes.city(1000)[0]
    first, again, other = (thin_at_random(points, 0.25, seed) for seed in (1, 1, 2))
    assert len(first) == 250 and (np.diff(first) > 0).all()
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert len(thin_at_random(points, 1e-9, 0)) == 1


@pytest.mark.parametrize("radius", [1e-6, 0.2, 100.0])
def test_disks_equal_darts(radius):
    points = shapes.plane_samples(3000)  # three batches
    points[1] = points[0]  # of duplicates, one is kept
    kept = thin_by_disks(points, radius, 3)
    np.testing.assert_array_equal(kept, darts(points, radius, 3))
    assert cKDTree(points[kept]).query_pairs(radius) == set()
    assert cKDTree(points[kept]).query(points)[0].max() <= radius  # no point could be added


def test_disks_of_a_dense_cluster_need_little_memory(monkeypatch):
    """Half of 20,000 points lie within one radius: all their pairs would be 100 million."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0, 0.01, (10_000, 3)), rng.uniform(0, 100, (10_000, 3))])
    counts = []
    query_radius = thinning.Index.query_radius

    def counted(index, *args):
        found = query_radius(index, *args)
        counts.append(len(found.indices))
        return found

    monkeypatch.setattr(thinning.Index, "query_radius", counted)
    kept = thin_by_disks(points, 0.1, 0)
    # The first batch of 1,000 has some 500 points in the cluster, and 250,000 pairs; later ones have few.
    assert sum(counts) < 1_000_000
    assert (kept < 10_000).sum() == 1


def test_lengths_for_a_share():
    points = shapes.city(5000)[0]
    for share in (0.5, 0.1):
        voxels = len(voxel_downsample(points, voxel_side_for(points, share)))
        disks = len(thin_by_disks(points, disk_radius_for(points, share), 9))
        assert voxels == pytest.approx(share * len(points), rel=0.05)
        # The radius is found with another seed, to 2 %.
        assert disks == pytest.approx(share * len(points), rel=0.05)


def test_wrong_shares_are_refused():
    for share in (0.0, 1.5, float("nan")):
        with check_error():
            thin_at_random(shapes.plane_samples(10), share, 0)
