"""Metrics of pairs alone: against slow formulas and `compare`, for each kind of input, and what they import."""

import subprocess
import sys

import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error

import pcbench
from pcbench.measure.score_pairs import METRICS

ALL = {"metrics": METRICS, "thresholds": (0.05, 0.1)}
# Sums of a few hundred values in another order, and coordinates moved near the origin.
CLOSE = 1e-12


def clouds(seed=0, count=300):
    generator = np.random.default_rng(seed)
    reference, candidate = generator.random((count, 3)), generator.random((count + 50, 3))
    return reference, candidate


def slow_distances(queries, others):
    return np.sqrt(((queries[:, None] - others[None]) ** 2).sum(axis=2).min(axis=1))


def test_metrics_are_those_of_their_formulas():
    reference, candidate = clouds()
    a, b = slow_distances(candidate, reference), slow_distances(reference, candidate)
    score = pcbench.score(reference, candidate, thresholds=(0.05,))
    assert score.mean_distance == pytest.approx((a.mean(), b.mean()), rel=CLOSE)
    assert score.d1_mse == pytest.approx((np.mean(a**2), np.mean(b**2)), rel=CLOSE)
    assert score.d1_rms == pytest.approx((np.mean(a**2) ** 0.5, np.mean(b**2) ** 0.5), rel=CLOSE)
    assert score.chamfer == pytest.approx(a.mean() + b.mean(), rel=CLOSE)
    assert score.chamfer_squared == pytest.approx(np.mean(a**2) + np.mean(b**2), rel=CLOSE)
    assert score.hausdorff == pytest.approx(max(a.max(), b.max()), rel=CLOSE)
    (at_threshold,) = score.fscore
    precision, recall = np.mean(a <= 0.05), np.mean(b <= 0.05)
    assert at_threshold == pytest.approx((0.05, precision, recall, 2 * precision * recall / (precision + recall)))
    assert score.d2_rms is None


def test_they_equal_those_of_a_comparison_in_the_given_pose():
    reference, candidate = clouds(1, 500)
    settings = pcbench.Settings(register="none", thresholds=(0.05, 0.1))
    metrics = pcbench.compare(reference, candidate, settings).candidates[0].metrics
    score = pcbench.score(reference, candidate, **ALL)
    for name in ("d1_mse", "d2_mse", "mean_distance"):
        both = getattr(metrics, name)
        assert getattr(score, name) == pytest.approx((both.accuracy.value, both.completeness.value), rel=CLOSE)
    assert score.hausdorff == pytest.approx(metrics.hausdorff.symmetric_max, rel=CLOSE)
    assert score.chamfer_squared == pytest.approx(metrics.chamfer.sum_squared.value, rel=CLOSE)
    assert [row.fscore for row in score.fscore] == [row.fscore.value for row in metrics.fscores]


def test_every_kind_of_cloud_is_taken(tmp_path):
    reference, candidate = (points.astype(np.float32).astype(np.float64) for points in clouds(2))
    expected = pcbench.score(reference, candidate, **ALL)
    pcbench.write_cloud(tmp_path / "a.ply", reference)
    kinds = [
        pcbench.score(reference.astype(np.float32), candidate.astype(np.float32), **ALL),
        pcbench.score(pcbench.Cloud(reference), np.asfortranarray(candidate), **ALL),
        pcbench.score(reference.tolist(), candidate, **ALL),
        pcbench.score(tmp_path / "a.ply", candidate, **ALL),
        pcbench.score(str(tmp_path / "a.ply"), candidate, **ALL),
    ]
    assert all(score == expected for score in kinds)


def test_tensors_are_taken_also_with_gradients():
    torch = import_or_skip("torch")
    reference, candidate = clouds(3)
    expected = pcbench.score(reference, candidate)
    tensor = torch.from_numpy(reference).requires_grad_()
    assert pcbench.score(tensor, torch.from_numpy(candidate)) == expected
    halved = torch.from_numpy(reference).bfloat16()
    assert pcbench.score(halved, candidate) == pcbench.score(halved.double(), candidate)
    assert pcbench.score(torch.from_numpy(reference).float(), candidate) == pcbench.score(
        reference.astype(np.float32), candidate
    )


def test_normals_of_the_reference_are_used_in_both_directions():
    generator = np.random.default_rng(4)
    reference = np.c_[generator.random((200, 2)), np.zeros(200)]
    candidate = np.c_[generator.random((200, 2)), np.full(200, 0.25)]
    up = pcbench.Cloud(reference, normals=np.tile((0.0, 0.0, 3.0), (200, 1)))
    # Rounding of products of coordinates below 1.
    assert pcbench.score(up, candidate, "d2_rms").d2_rms == pytest.approx((0.25, 0.25), abs=1e-12)
    assert pcbench.score(reference, candidate, "d2_rms").d2_rms == pytest.approx((0.25, 0.25), abs=1e-12)
    sideways = pcbench.Cloud(reference, normals=np.tile((1.0, 0.0, 0.0), (200, 1)))
    assert max(pcbench.score(sideways, candidate, "d2_rms").d2_rms) < 0.2


def test_normals_of_a_file_are_used(tmp_path):
    reference, candidate = clouds()
    cloud = pcbench.Cloud(reference, normals=np.tile([0.0, 0.0, 1.0], (len(reference), 1)))
    pcbench.write_cloud(tmp_path / "a.ply", cloud)
    expected = pcbench.score(cloud, candidate, "d2_rms").d2_rms
    assert pcbench.score(tmp_path / "a.ply", candidate, "d2_rms").d2_rms == expected


def test_large_coordinates_lose_nothing():
    reference, candidate = clouds(5)
    offset = np.array([3_500_000.0, 5_800_000.0, 200.0])
    near, far = pcbench.score(reference, candidate), pcbench.score(reference + offset, candidate + offset)
    # The coordinates themselves are rounded to 1e-9.
    assert list(far.values().values()) == pytest.approx(list(near.values().values()), abs=4e-9)


def test_swapped_clouds_swap_the_directions():
    reference, candidate = clouds(6)
    score, swapped = pcbench.score(reference, candidate), pcbench.score(candidate, reference)
    assert tuple(swapped.d1_rms) == tuple(reversed(score.d1_rms))
    assert (swapped.chamfer, swapped.hausdorff) == (score.chamfer, score.hausdorff)


def test_values_have_a_name_each():
    score = pcbench.score(*clouds(), metrics=("hausdorff", "d1_rms", "fscore"), thresholds=(0.1,))
    assert list(score.values()) == [
        *("d1_rms.c2r", "d1_rms.r2c", "hausdorff", "precision@0.1", "recall@0.1", "fscore@0.1"),
    ]


@pytest.mark.parametrize("name", ["fscore@0.2", "precision@0.2", "recall@2e-1"])
def test_a_name_may_have_a_threshold(name):
    pair = clouds()
    expected = pcbench.score(*pair, metrics=("hausdorff", "fscore"), thresholds=(0.1, 0.2))
    assert pcbench.score(*pair, metrics=("fscore@0.1", "hausdorff", name)) == expected
    assert pcbench.score_many([pair], metrics=["hausdorff", name], thresholds=np.array([0.1])) == [expected]


def test_many_pairs_have_the_scores_of_each():
    pairs = [clouds(seed, 60) for seed in range(9)]
    expected = [pcbench.score(*pair) for pair in pairs]
    assert pcbench.score_many(pairs) == expected
    assert pcbench.score_many(iter(pairs), threads=3) == expected
    assert pcbench.score_many([]) == []


def test_errors_name_the_argument_and_the_pair():
    reference, candidate = clouds()
    for metrics in ("chamfers", ("fscore",), "fscore@-1", "chamfer@1"):
        with check_error():
            pcbench.score(reference, candidate, metrics)
    for wrong in (
        candidate[:, :2],
        np.full((3, 3), np.nan),
        np.empty((0, 3)),
        ["a"],
        candidate > 0.5,
        np.ma.masked_less(candidate, 0.5),
    ):
        with check_error():
            pcbench.score(reference, wrong)
    with check_error():
        pcbench.score_many([(reference, candidate), (reference, candidate[:, :2])])
    with check_error():
        pcbench.score_many([(reference, candidate)], threads=0)
    with check_error():
        pcbench.score_many([reference, candidate])
    for thresholds in (0.1, (0.0,)):
        with check_error():
            pcbench.score(reference, candidate, thresholds=thresholds)
    with check_error():
        pcbench.score(pcbench.Cloud(reference, unit="m"), pcbench.Cloud(candidate, unit="mm"))


def test_neither_registration_nor_verdict_is_imported():
    code = (
        "import sys, numpy, pcbench; pcbench.score(numpy.eye(3), numpy.ones((3, 3)));"
        "print(*{'.'.join(name.split('.')[:2]) for name in sys.modules})"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    rooms = ("deformation", "registration", "changes", "report", "comparison", "studies")
    assert {"scipy", "torch", "pandas", *(f"pcbench.{room}" for room in rooms)}.isdisjoint(answer.stdout.split())
