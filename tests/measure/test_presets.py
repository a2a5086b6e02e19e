"""Presets: the same values as other tools print for the same aligned pair."""

import json
from dataclasses import replace

import numpy as np
import oracles
import pytest
import shapes
from data_folder import data_folder
from optional import import_or_skip
from wording import check_error, check_text

from pcbench import Cloud, Settings, compare, read_cloud, write_cloud
from pcbench.measure.library_presets import LIBRARY_PRESETS, OneWay

pytestmark = pytest.mark.usefixtures("without_deformation", "without_changes")


def compute_preset(name, reference, candidate, **settings):
    settings = Settings(register="none", presets=(name,), **settings)
    return compare(reference, candidate, settings).candidates[0].metrics.presets[name]


def printed_values(m):
    return {
        "mse1 (p2point)": m.d1_mse.a_to_b,
        "mse2 (p2point)": m.d1_mse.b_to_a,
        "mseF (p2point)": m.d1_mse.symmetric,
        "mse1 (p2plane)": m.d2_mse.a_to_b,
        "mse2 (p2plane)": m.d2_mse.b_to_a,
        "mseF (p2plane)": m.d2_mse.symmetric,
        "mseF,PSNR (p2point)": m.d1_psnr,
        "mseF,PSNR (p2plane)": m.d2_psnr,
        "h. (p2point)": m.hausdorff_squared_d1,
        "h. (p2plane)": m.hausdorff_squared_d2,
        "Peak distance for PSNR": m.peak,
    }


@pytest.mark.parametrize("case", ["wave", "outliers"])
def test_mpeg_equals_the_output_of_pc_error(case):
    folder = data_folder("dmetric")
    expected = json.loads((folder / "expected.json").read_text())["cases"][case]
    values = printed_values(
        compute_preset("mpeg", read_cloud(folder / f"{case}_a.ply"), read_cloud(folder / f"{case}_b.ply"))
    )
    for name, value in values.items():
        if name.startswith("mse") and "p2point" in name and "PSNR" not in name:
            assert f"{value:.9g}" == f"{expected[name]:.9g}", name  # to the printed digits
        else:
            assert value == pytest.approx(expected[name], rel=1e-5), name


@pytest.mark.parametrize("kind", ["random", "grid", "duplicates", "far"])
def test_mpeg_equals_the_oracle(kind):
    rng = np.random.default_rng(11)
    a, normals = shapes.terrain(600, seed=1)
    b = shapes.terrain(500, seed=2)[0] + rng.normal(0, 0.05, (500, 3))
    if kind == "grid":  # many ties
        a, b = np.unique(np.round(a), axis=0), np.unique(np.round(b), axis=0)
        normals = rng.normal(size=a.shape)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if kind == "duplicates":
        a, normals, b = np.repeat(a, 2, axis=0), np.repeat(normals, 2, axis=0), np.repeat(b, 3, axis=0)
    if kind == "far":
        a, b = np.round(a * 1024) / 1024 + [5e5, 4.8e6, 0], np.round(b * 1024) / 1024 + [5e5, 4.8e6, 0]
    expected = oracles.mpeg(a, normals, b)
    values = printed_values(compute_preset("mpeg", Cloud(a, normals=normals), b))
    for name, value in values.items():
        # 1e-6: coordinate differences are rounded to float32, as pc_error does.
        assert value == pytest.approx(expected[name], rel=1e-6), name


def test_mpeg_does_not_normalise_normals():
    a, normals = shapes.terrain(400, seed=1)
    b = shapes.terrain(300, seed=2)[0]
    values = printed_values(compute_preset("mpeg", Cloud(a, normals=2 * normals), b))
    assert values["mseF (p2plane)"] == pytest.approx(oracles.mpeg(a, 2 * normals, b)["mseF (p2plane)"], rel=1e-9)


def test_gao2025_equals_brute_force_with_a_hard_crop():
    a, b = shapes.terrain(900, seed=3)[0], shapes.terrain(700, seed=4)[0] + [0, 0, 0.1]
    low, high = np.array([10.0, 10, -10]), np.array([25.0, 30, 10])
    cropped_a, cropped_b = (c[((c >= low) & (c <= high)).all(axis=1)] for c in (a, b))
    result = compute_preset("gao2025", a, b, crop="box:10,10,-10,25,30,10")
    assert result.d1_mse == pytest.approx(oracles.d1(cropped_b, cropped_a), rel=1e-12)
    assert result.hausdorff == pytest.approx(oracles.hausdorff(cropped_a, cropped_b), rel=1e-12)
    assert result.chamfer == pytest.approx(oracles.chamfer_squared(cropped_a, cropped_b), rel=1e-12)
    assert result.d1_back_mse == pytest.approx(oracles.d1(cropped_a, cropped_b), rel=1e-12)
    normals = oracles.normals(a, 20)[((a >= low) & (a <= high)).all(axis=1)]
    assert result.d2_mse == pytest.approx(oracles.d2(cropped_b, cropped_a, normals), rel=1e-9)
    mpeg = compute_preset("mpeg", a, b, crop="box:10,10,-10,25,30,10")
    assert mpeg.d1_mse.a_to_b == pytest.approx(oracles.d1(cropped_a, cropped_b), rel=1e-6)
    assert mpeg.peak == pytest.approx(oracles.leave_one_out(cropped_a).max(), rel=1e-12)


def test_open3d_preset_equals_open3d():
    o3d = import_or_skip("open3d")
    a, b = shapes.terrain(900, seed=3)[0], shapes.terrain(700, seed=4)[0] + [0, 0, 0.1]
    result = compute_preset("open3d", a, b, thresholds=(0.3, 0.8))

    def to_open3d(points):
        return o3d.t.geometry.PointCloud(o3d.core.Tensor(points.astype(np.float32)))

    metrics = o3d.t.geometry.Metric
    names = [metrics.ChamferDistance, metrics.HausdorffDistance, metrics.FScore]
    radii = o3d.t.geometry.MetricParameters(fscore_radius=[0.3, 0.8])
    chamfer, hausdorff, *fscores = to_open3d(a).compute_metrics(to_open3d(b), names, radii).numpy()
    # 1e-5: Open3D computes in float32.
    assert result.chamfer == pytest.approx(chamfer, rel=1e-5)
    assert result.hausdorff == pytest.approx(hausdorff, rel=1e-5)
    assert [100 * row.fscore for row in result.fscore] == pytest.approx(fscores, rel=1e-5)


def test_a_given_peak_changes_the_psnr_alone():
    folder = data_folder("dmetric")
    clouds = [read_cloud(folder / f"wave_{name}.ply") for name in "ab"]
    computed, given = (compute_preset("mpeg", *clouds, mpeg_peak=peak) for peak in (None, 1023))
    assert given.peak == 1023
    assert given.d1_psnr == pytest.approx(10 * np.log10(3 * 1023**2 / computed.d1_mse.symmetric), rel=1e-12)
    assert given.d2_psnr == pytest.approx(10 * np.log10(3 * 1023**2 / computed.d2_mse.symmetric), rel=1e-12)
    assert replace(given, peak=computed.peak, d1_psnr=computed.d1_psnr, d2_psnr=computed.d2_psnr) == computed


def test_a_given_peak_is_stored_and_shown(tmp_path, run):
    a, b = shapes.terrain(200, seed=3)[0], shapes.terrain(200, seed=4)[0]
    for name, points in (("a", a), ("b", b)):
        write_cloud(tmp_path / f"{name}.ply", Cloud(points))
    arguments = ["compare", tmp_path / "a.ply", tmp_path / "b.ply", "--register", "none", "--full"]
    code, out, _ = run(*arguments, "--mpeg-peak", "1023", "--json", tmp_path / "a.json")
    assert code == 0
    check_text(next(line for line in out.splitlines() if "mpeg: peak" in line), masked=False)
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["settings"]["mpeg_peak"] == 1023
    assert document["candidates"][0]["metrics"]["presets"]["mpeg"]["peak"] == 1023
    for peak in ("0", "nan"):
        assert run(*arguments, "--mpeg-peak", peak)[0] == 2
    for peak in (-1, float("inf"), "1023", True):
        with check_error():
            Settings(mpeg_peak=peak)


def test_identical_clouds_have_no_psnr():
    a = shapes.terrain(200)[0]
    result = compute_preset("mpeg", a, a)
    assert result.d1_mse.symmetric == 0
    assert result.d1_psnr is None


@pytest.mark.parametrize("name", ["nonsense", "dtu", "GAO25"])
def test_an_unknown_preset_is_refused(name):
    with check_error():
        Settings(presets=(name,))


def test_pdal_preset_equals_the_output_of_pdal():
    folder = data_folder("autzen")
    clouds = [read_cloud(folder / name) for name in ("autzen-thin.las", "autzen_trim.las")]
    result = compute_preset("pdal", *clouds)
    assert result.chamfer == pytest.approx(5.907628766e10, rel=1e-9)
    assert result.hausdorff == pytest.approx(4416.968175, rel=1e-9)


def test_pdal_preset_equals_brute_force():
    a, b = shapes.terrain(300, seed=3)[0], shapes.terrain(200, seed=4)[0]
    assert compute_preset("pdal", a, b).chamfer == pytest.approx(oracles.chamfer_sum_of_squares(a, b), rel=1e-12)


def one_way(a, b, thresholds=()):
    """Distances of the points b to a and of a to b: candidate → reference, and back."""
    distances = np.linalg.norm(a[:, None] - b, axis=2)
    return OneWay.of(distances.min(axis=0), thresholds), OneWay.of(distances.min(axis=1), thresholds)


def test_point_cloud_utils_preset_equals_the_library():
    rng = np.random.default_rng(12)
    a, b = rng.random((60, 3)).round(6), (rng.random((50, 3)) + [0, 0, 0.1]).round(6)
    result = LIBRARY_PRESETS["point-cloud-utils"](*one_way(a, b), ())
    # Printed by point-cloud-utils 0.34.0: chamfer_distance(a, b), hausdorff_distance(a, b), and
    # one_sided_hausdorff_distance of (a, b) and (b, a).
    assert result.chamfer == pytest.approx(0.31124784308929027, rel=1e-14)
    assert result.hausdorff == pytest.approx(0.39152709864580254, rel=1e-14)
    assert result.one_sided_hausdorff.a_to_b == pytest.approx(0.39152709864580254, rel=1e-14)
    assert result.one_sided_hausdorff.b_to_a == pytest.approx(0.31435833136724717, rel=1e-14)


def test_kaolin_preset_equals_the_examples_in_its_documentation():
    """The values are those in the docstrings of `chamfer_distance` and `f_score`, printed in float32."""
    first = np.array([[8.8977, 4.1709, 1.2839], [8.5640, 7.7767, 9.4214]])
    chamfer = LIBRARY_PRESETS["kaolin"](
        *one_way(first, np.array([[6.9340, 6.1152, 3.4435], [0.1032, 9.8181, 11.3350]])), ()
    )
    assert chamfer.chamfer == pytest.approx(72.5838, rel=1e-6)
    for truth, predicted, expected in (
        (first, [[9.4863, 4.2249, 0.1712], [8.1783, 8.5310, 8.5119]], (0.0, 1.0)),
        ([[0.5431, 6.4495, 11.4914], [3.2126, 8.0865, 3.1018]],
         [[-0.0020699, 6.4429, 12.3], [3.8386, 8.3585, 4.7662]], (0.5, 0.5)),
    ):  # fmt: skip
        ways = one_way(np.array(truth), np.array(predicted), (1.0, 1.5))
        scores = LIBRARY_PRESETS["kaolin"](*ways, (1.0, 1.5)).fscore
        assert [round(row.fscore, 4) for row in scores] == list(expected)


def test_presets_of_libraries_equal_their_formulas():
    a, b = shapes.terrain(300, seed=3)[0], shapes.terrain(200, seed=4)[0] + [0, 0, 0.1]
    forth, back = (np.linalg.norm(a[:, None] - b, axis=2).min(axis=axis) for axis in (0, 1))
    pytorch3d = compute_preset("pytorch3d", a, b)
    assert pytorch3d.chamfer == pytest.approx(np.mean(forth**2) + np.mean(back**2), rel=1e-12)
    assert pytorch3d.single_directional.a_to_b == pytest.approx(np.mean(back**2), rel=1e-12)
    assert pytorch3d.single_directional.b_to_a == pytest.approx(np.mean(forth**2), rel=1e-12)
    kaolin = compute_preset("kaolin", a, b, thresholds=(0.8,))
    assert kaolin.chamfer == pytorch3d.chamfer
    assert kaolin.chamfer_unsquared == pytest.approx(forth.mean() + back.mean(), rel=1e-12)
    hits, misses = np.count_nonzero(forth <= 0.8), np.count_nonzero(back > 0.8)
    [row] = kaolin.fscore
    assert (row.precision, row.recall) == pytest.approx((hits / len(b), hits / (hits + misses)), rel=1e-12)
    assert misses > 0 and row.recall != pytest.approx(np.mean(back <= 0.8), rel=1e-3)  # not the usual recall
    utils = compute_preset("point-cloud-utils", a, b)
    assert (utils.chamfer, utils.hausdorff) == (kaolin.chamfer_unsquared, max(forth.max(), back.max()))


def test_tnt_preset_equals_downsampling_by_open3d():
    o3d = import_or_skip("open3d")
    a, b = shapes.terrain(3000, seed=3)[0], shapes.terrain(2000, seed=4)[0] + [0, 0, 0.05]
    low, high = np.array([5.0, 5, -10]), np.array([35.0, 30, 10])
    rows = compute_preset("tnt", a, b, thresholds=(0.5, 1.5), crop="box:5,5,-10,35,30,10").fscore

    def downsample(points, side):
        inside = points[((points >= low) & (points <= high)).all(axis=1)]
        return np.asarray(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(inside)).voxel_down_sample(side).points)

    for row in rows:
        expected = oracles.fscore(downsample(b, row.threshold / 2), downsample(a, row.threshold / 2), row.threshold)
        assert (row.precision, row.recall, row.fscore) == pytest.approx(expected)


def test_hausdorff_equals_pymeshlab():
    pymeshlab = import_or_skip("pymeshlab")
    a, b = shapes.terrain(900, seed=3)[0], shapes.terrain(700, seed=4)[0] + [0, 0, 0.1]
    meshes = pymeshlab.MeshSet()
    for points in (a, b):
        meshes.add_mesh(pymeshlab.Mesh(points))
    expected = meshes.get_hausdorff_distance(
        sampledmesh=1, targetmesh=0, samplevert=True, sampleface=False, maxdist=pymeshlab.PercentageValue(100)
    )
    m = compare(a, b, Settings(register="none")).candidates[0].metrics
    # MeshLab works in float32.
    assert m.hausdorff.accuracy.largest == pytest.approx(expected["max"], rel=1e-5)
    assert m.mean_distance.accuracy.value == pytest.approx(expected["mean"], rel=1e-5)
    assert m.d1_rms.accuracy.value == pytest.approx(expected["RMS"], rel=1e-5)
