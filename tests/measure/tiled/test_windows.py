"""Registration of clouds that are too large for it, from windows at full density, and what follows from the pose."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
from data_folder import data_folder
from partial_comparisons import skip_changes, skip_deformation
from tiled_clouds import in_this_process, stored_runs
from tiled_pairs import compare_on_disk

from pcbench import compare
from pcbench.errors import RegistrationError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity
from pcbench.io import read_cloud, write_cloud
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE
from pcbench.measure.settings import Settings
from pcbench.measure.tiled import windows
from pcbench.measure.tiled.alignment import UNREPRESENTATIVE_SAMPLE
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.scenes.synthetic import demo

WAYS = CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE


def in_windows(folder, reference, candidates, settings=None, *, with_memory=True):
    """Compare clouds in tiles and in windows, and in memory."""
    folder.mkdir(exist_ok=True)
    paths = {name: folder / f"{name}.ply" for name in ("ref", *candidates)}
    for name, cloud in {"ref": reference, **candidates}.items():
        write_cloud(paths[name], cloud if isinstance(cloud, Cloud) else Cloud(np.asarray(cloud)))
    read = {name: read_cloud(path) for name, path in paths.items()}
    settings = settings or Settings(presets=())
    first_cloud = read.pop("ref")
    memory = compare(first_cloud, read, settings) if with_memory else None
    first = paths.pop("ref")
    return compare_on_disk(first, paths, settings, TilingSettings(10_000, workers=1), workspace=folder), memory


def shift_between(a, b, points):
    """RMS distance between points moved by the registrations of two results."""
    moved = [candidate.registration.T_reference_candidate.apply(points) for candidate in (a, b)]
    return np.sqrt(np.mean(np.square(moved[0] - moved[1]).sum(axis=1)))


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """A city with a sparse and a dense, bent candidate: its points, and its comparisons in tiles and in memory."""
    with pytest.MonkeyPatch.context() as patch:
        in_this_process(patch)
        patch.setattr(windows, "MAX_SAMPLE", 60_000)
        scene = demo(200_000)
        return scene, *in_windows(tmp_path_factory.mktemp("city"), scene.reference, scene.candidates)


@pytest.mark.long
@pytest.mark.parametrize("name", ["sparse", "densified"])
def test_windows_find_the_pose_of_the_complete_clouds(city, name):
    """Points have an error of 4 to 6 cm; a pose from a third of them is uncertain by a fraction of that."""
    scene, tiled, memory = city
    assert tiled.tiling.sampled_points < 90_000
    assert shift_between(tiled[name], memory[name], scene.candidates[name].points) < 0.05
    assert [w.code for w in tiled[name].warnings if w.code == UNREPRESENTATIVE_SAMPLE] == []
    for metric in ("d1_mse", "mean_distance"):
        for way in WAYS:
            ours, theirs = (result[name].metrics.directed[metric][way].value for result in (tiled, memory))
            assert ours == pytest.approx(theirs, rel=0.01)


@pytest.mark.long
@pytest.mark.parametrize("name", ["sparse", "densified"])
def test_floors_are_those_of_the_complete_clouds(city, name):
    """They are measured from the same rows, after a slightly different registration."""
    _, tiled, memory = city
    for way in WAYS:
        ours, theirs = (result[name].metrics.directed["mean_distance"][way].floor for result in (tiled, memory))
        assert ours == pytest.approx(theirs, rel=0.02)


@pytest.mark.long
def test_a_deformation_after_registration_in_windows(city):
    _, tiled, memory = city
    assert tiled["densified"].deformation.verdict == memory["densified"].deformation.verdict == "non-affine"
    assert tiled["sparse"].deformation.verdict in ("none", "undecided")  # 2,000 points in few windows say little


def surface(rng, count, size=60.0):
    points = rng.random((count, 3)) * size
    points[:, 2] = 3 * np.sin(points[:, 0] / 5) + 2 * np.cos(points[:, 1] / 4)
    return points


def noisy(rng, points, sigma=0.02):
    return points + rng.normal(size=points.shape) * sigma


def shrink_windows(monkeypatch):
    in_this_process(monkeypatch)
    monkeypatch.setattr(windows, "MAX_SAMPLE", 5_000)
    monkeypatch.setattr(windows, "_WINDOW_POINTS", 500)


@pytest.fixture
def small_windows(monkeypatch):
    """Shrink the windows, and skip the search for changes and the test for deformation."""
    shrink_windows(monkeypatch)
    skip_deformation(monkeypatch)
    skip_changes(monkeypatch)


@pytest.mark.parametrize("most", [7_000, 13_000])
def test_windows_have_the_wanted_number_of_points(tmp_path, monkeypatch, most):
    """The windows of the reference differ from those of the candidate, although both cover the same ground."""
    monkeypatch.setattr(windows, "MAX_SAMPLE", most)
    monkeypatch.setattr(windows, "_WINDOW_POINTS", 500)
    points = surface(np.random.default_rng(0), 40_000)
    stored = SimpleNamespace(count=len(points), runs=stored_runs(tmp_path / "runs", points)[0])
    chosen = windows.Windows.of(stored, points[::9], len(points))
    inside = windows._range_of(chosen.lattice.codes(points), chosen.ranges) >= 0
    # The mean of some tens of windows with 250 to 500 points each is known to a few percent.
    assert np.count_nonzero(inside) == pytest.approx(most, rel=0.15)
    assert (chosen.ranges[1:, 0] >= chosen.ranges[:-1, 1]).all()


def test_a_candidate_in_a_corner_is_registered_there(tmp_path, small_windows):
    rng = np.random.default_rng(0)
    points = surface(rng, 20_000)
    corner = noisy(rng, points[(points[:, :2] < 12).all(axis=1)])
    shift = np.array([0.15, -0.1, 0.05])
    tiled, memory = in_windows(tmp_path, points, {"corner": corner - shift}, Settings(presets=(), register="icp"))
    assert tiled.tiling.sampled_points < 10_000
    # 800 points with 2 cm of noise: the pose is uncertain by about a millimetre, in half of them by little more.
    assert shift_between(tiled["corner"], memory["corner"], corner) < 0.01
    assert tiled["corner"].points == len(corner)


@pytest.mark.parametrize(
    "kind", [*(pytest.param(kind, marks=pytest.mark.long) for kind in ("icp", "matrix")), "similarity"]
)
def test_methods_of_registration_in_windows(tmp_path, small_windows, kind):
    rng = np.random.default_rng(1)
    points = surface(rng, 15_000)
    truth = Similarity(np.eye(3), np.array([0.2, -0.1, 0.05]), 1.002 if kind == "similarity" else 1.0)
    candidate = truth.inverse().apply(noisy(rng, points[::2]))
    method = kind
    if kind == "matrix":
        np.savetxt(tmp_path / "pose.txt", truth.matrix)
        method = f"matrix:{tmp_path / 'pose.txt'}"
    tiled, memory = in_windows(tmp_path / "work", points, {"a": candidate}, Settings(presets=(), register=method))
    limit = 0.01 if kind in ("icp", "similarity") else 1e-9
    assert shift_between(tiled["a"], memory["a"], candidate) < limit
    assert tiled["a"].registration.T_local.scale == pytest.approx(memory["a"].registration.T_local.scale, abs=2e-4)
    assert tiled["a"].metrics.directed["d2_mse"][WAYS[0]].value == pytest.approx(0.02**2, rel=0.1)


@pytest.mark.long
def test_a_region_smaller_than_a_window(tmp_path, small_windows):
    rng = np.random.default_rng(2)
    points = surface(rng, 15_000)
    settings = Settings(presets=(), crop="box:20,20,-9,21,21,9", register="icp")
    tiled, memory = in_windows(tmp_path, points, {"a": noisy(rng, points[::2])}, settings)
    assert tiled["a"].points_in_region == memory["a"].points_in_region
    assert shift_between(tiled["a"], memory["a"], points) < 0.01


@pytest.mark.parametrize("ratio", [1 / 300, 300])
def test_a_candidate_of_another_density(tmp_path, small_windows, ratio):
    """The sample stays small whatever the other cloud's density."""
    rng = np.random.default_rng(3)
    dense, sparse = surface(rng, 20_000), surface(rng, 67)
    reference, candidate = (sparse, dense) if ratio > 1 else (dense, sparse)
    tiled, memory = in_windows(tmp_path, reference, {"a": noisy(rng, candidate)}, Settings(presets=(), register="none"))
    assert tiled.tiling.sampled_points < 10_000
    for way in WAYS:
        ours, theirs = (result["a"].metrics.directed["mean_distance"][way] for result in (tiled, memory))
        assert ours.value == pytest.approx(theirs.value, rel=1e-12)
        assert ours.floor == theirs.floor  # which no window shows


def test_a_candidate_of_one_point(tmp_path, small_windows):
    points = surface(np.random.default_rng(3), 15_000)
    tiled, memory = in_windows(tmp_path, points, {"a": [[30.0, 30.0, 1.0]]}, Settings(presets=(), register="none"))
    for way in WAYS:
        ours, theirs = (result["a"].metrics.directed["mean_distance"][way].value for result in (tiled, memory))
        assert ours == pytest.approx(theirs, rel=1e-12)


def test_clouds_that_do_not_overlap_are_refused(tmp_path, small_windows):
    points = surface(np.random.default_rng(3), 15_000)
    paths = {name: tmp_path / f"{name}.ply" for name in ("ref", "a")}
    for name, cloud in (("ref", points), ("a", points[::2] + 1000.0)):
        write_cloud(paths[name], Cloud(cloud))
    with pytest.raises(RegistrationError, match="does not overlap"):
        compare_on_disk(
            paths["ref"], {"a": paths["a"]}, Settings(register="none"), TilingSettings(5000), workspace=tmp_path
        )


def test_a_dense_candidate_is_thinned_by_the_workers(tmp_path, small_windows, monkeypatch):
    """Windows of a sparse reference contain most of a dense candidate."""
    returned = []
    points_in_windows = windows.points_in_windows

    @functools.wraps(points_in_windows)  # the annotation names the type of the stored result
    def counted(*arguments):
        found = points_in_windows(*arguments)
        returned.append(len(found.points))
        return found

    monkeypatch.setattr(windows, "points_in_windows", counted)
    counted.__module__, counted.__qualname__ = windows.__name__, "points_in_windows"
    rng = np.random.default_rng(3)
    candidate = noisy(rng, surface(rng, 30_000))
    in_windows(
        tmp_path, surface(rng, 2_000), {"a": candidate}, Settings(presets=(), register="none"), with_memory=False
    )
    assert 0 < sum(returned) < 11_000


@pytest.mark.long
def test_halves_of_one_cloud_are_not_deformed_in_windows(tmp_path, monkeypatch):
    shrink_windows(monkeypatch)
    rng = np.random.default_rng(4)
    points = noisy(rng, surface(rng, 30_000), 0.05)
    order = rng.permutation(len(points))
    tiled, _ = in_windows(tmp_path, points[order[::2]], {"a": points[order[1::2]]}, with_memory=False)
    assert tiled["a"].deformation.verdict in ("none", "undecided")


@pytest.mark.long
@pytest.mark.parametrize(
    ("folder", "file"),
    [("wild", "MixedConifer.laz"), ("wild", "Topography.laz"), ("scans", "webots1.xyz"), ("scans", "vehicle0.xyz")],
)
def test_halves_of_real_clouds_are_not_deformed_in_windows(tmp_path, monkeypatch, folder, file):
    in_this_process(monkeypatch)
    cloud = read_cloud(data_folder(folder) / file, on_warning=lambda _: None).points
    order = np.random.default_rng(0).permutation(len(cloud))[:300_000]
    monkeypatch.setattr(windows, "MAX_SAMPLE", len(order) // 8)
    tiled, _ = in_windows(tmp_path, cloud[order[::2]], {"a": cloud[order[1::2]]}, with_memory=False)
    assert tiled.tiling.sampled_points < len(order) / 4
    assert tiled["a"].deformation.verdict in ("none", "undecided")
