"""A candidate mesh is measured at points sampled on its faces, unless its vertices are requested."""

import json

import numpy as np
import pytest
from mesh_bytes import CUBES
from mesh_shapes import spiky_sphere
from wording import check_error, check_text

import pcbench
from pcbench import Settings, TilingSettings, compare, deform, register
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import SAMPLED_MESH, sample_candidate
from pcbench.geometry.splats import SPLAT_MEANS
from pcbench.io.ply import write_ply_mesh
from pcbench.report import document

pytestmark = pytest.mark.usefixtures("without_deformation", "without_changes")

NOISE = 0.002
UNREGISTERED = Settings("none", thresholds=(0.05,), seed=3)


@pytest.fixture(autouse=True)
def few_samples(monkeypatch):
    monkeypatch.setattr("pcbench.geometry.mesh_samples._MIN_DEFAULT_SAMPLES", 1000)
    monkeypatch.setattr("pcbench.geometry.mesh_samples.REFERENCE_SAMPLES", 20_000)


@pytest.fixture(scope="module")
def mesh():
    return Mesh(*spiky_sphere(1), unit="m")


@pytest.fixture(scope="module")
def reference(mesh):
    points = mesh.sample(1000, seed=1).points
    return Cloud(points + np.random.default_rng(2).normal(0, NOISE, points.shape), unit="m")


@pytest.fixture
def files(tmp_path, mesh, reference):
    pcbench.write_cloud(tmp_path / "reference.ply", reference)
    write_ply_mesh(tmp_path / "mesh.ply", mesh)
    return tmp_path / "reference.ply", tmp_path / "mesh.ply"


def codes(warnings):
    return [notice.code for notice in warnings]


def test_a_mesh_is_sampled(mesh, reference):
    comparison = compare(reference, {"mesh": mesh}, UNREGISTERED)
    [found] = comparison
    assert (found.points, found.faces) == (10_000, 80)
    assert codes(found.warnings)[0] == SAMPLED_MESH and str(found.warnings[0]).endswith("(seed 3)")
    check_text(found.warnings[0])
    # At the threshold, three times the median spacing of the samples, only the noise of the reference counts.
    score = found.metrics.fscores[0]
    assert score.recall.value > 0.98
    # Samples are about 0.5 / sqrt(density) off the reference's points, which are 10 times as sparse.
    density = len(reference) / mesh.area
    assert found.metrics.mean_distance.accuracy.value == pytest.approx(0.5 / density**0.5, rel=0.1)
    # Half of the samples' spacing of 0.5 / sqrt(10 density), and the noise across the surface.
    assert found.metrics.mean_distance.completeness.value < 0.5 / (10 * density) ** 0.5 + NOISE
    assert document(comparison)["candidates"][0]["faces"] == 80


def test_vertices_on_request(mesh, reference):
    [found] = compare(reference, [mesh], UNREGISTERED, vertices=True)
    assert (found.points, found.faces) == (len(mesh.vertices), None)
    assert SAMPLED_MESH not in codes(found.warnings)
    assert found.metrics.fscores[0].recall.value < 0.1
    assert Settings().plain().keys() ^ Settings(vertices=True).plain().keys() == {"vertices"}
    with check_error():
        Settings(vertices=1)


def test_the_number_of_samples(mesh):
    for count, expected in ((10, 1000), (400, 4000)):
        assert len(sample_candidate(mesh, Cloud(np.zeros((count, 3))))) == expected
    assert len(sample_candidate(mesh, mesh)) == 20_000


def test_a_given_number_of_samples(mesh, reference, files, run, tmp_path):
    comparison = compare(reference, [mesh], UNREGISTERED, samples=7000)
    [found] = comparison
    assert found.points == 7000 and "measured at 7,000 points" in str(found.warnings[0])
    assert document(comparison)["settings"]["samples"] == 7000
    both = compare(mesh, [mesh], UNREGISTERED, samples=500)
    assert (both.reference.points, both.candidates[0].points) == (500, 500)
    arguments = ("compare", *files, "--register", "none", "--sample", "900", "--json", tmp_path / "a.json")
    assert run(*arguments)[0] == 0
    assert json.loads((tmp_path / "a.json").read_text())["candidates"][0]["points"] == 900
    for samples in (0, 10**9, 2.5, True):
        with check_error():
            Settings(samples=samples)
    with check_error():
        compare(reference, [reference], UNREGISTERED, samples=100)


def test_a_sampled_mesh_has_another_score_than_its_vertices(mesh):
    """Samples show that a coarse mesh is right; its vertices do not cover the surface."""
    dense, settings = mesh.sample(8000, seed=1), Settings("none", thresholds=(0.1,))
    sampled, vertices = (compare(dense, [mesh], settings, vertices=value).candidates[0] for value in (False, True))
    assert sampled.metrics.fscores[0].fscore.value > 0.97
    assert vertices.metrics.fscores[0].fscore.value < 0.2
    assert SAMPLED_MESH in codes(sampled.warnings) and SAMPLED_MESH not in codes(vertices.warnings)


def test_splats_are_measured_at_their_means(reference, tmp_path):
    count = len(reference)
    attributes = dict.fromkeys(("opacity", "scale_0", "scale_1", "scale_2", "rot_0"), np.zeros(count, np.float32))
    splats = Cloud(reference.points + 0.01, unit="m", attributes=attributes)
    [found] = compare(reference, [splats], UNREGISTERED)
    check_text(next(notice for notice in found.warnings if notice.code == SPLAT_MEANS))
    assert SPLAT_MEANS not in codes(compare(splats, [reference], UNREGISTERED).candidates[0].warnings)
    for name, cloud in (("a", reference), ("b", splats)):
        pcbench.write_cloud(tmp_path / f"{name}.ply", cloud)
    tiling = TilingSettings(5000, workers=1)
    [tiled] = compare(tmp_path / "a.ply", tmp_path / "b.ply", UNREGISTERED, tiling=tiling, workspace=tmp_path / "work")
    assert SPLAT_MEANS in codes(tiled.warnings)


def test_samples_too_far_apart_for_the_reference(mesh, reference, monkeypatch):
    monkeypatch.setattr("pcbench.geometry.mesh_samples._MAX_DEFAULT_SAMPLES", 2000)
    [found] = compare(reference, [mesh], UNREGISTERED)
    check_text(found.warnings[0])


def test_meshes_in_python(mesh, reference):
    pose = register(reference, mesh, "none")
    assert SAMPLED_MESH in codes(pose.warnings) and pose.overlap == 1
    assert register(mesh, reference, "none").overlap == 1
    pose, deformation = deform(reference, mesh, "none", seed=5)
    assert SAMPLED_MESH in codes(pose.warnings) and "(seed 5)" in str(pose.warnings[0])
    assert deformation.pairs > 500


def test_meshes_in_files(files, run, tmp_path):
    reference, mesh = files
    for command in ("register", "deform"):
        code, out, err = run(command, reference, mesh, "--register", "none")
        assert code == 0 and "measured at 10,000 points" in err
        code, out, err = run(command, reference, mesh, "--register", "none", "--vertices")
        assert code == 0 and "sampled" not in out + err
    code, out, err = run("compare", reference, mesh, "--register", "none", "--json", tmp_path / "a.json")
    assert code == 0 and "measured at 10,000 points" in out
    assert json.loads((tmp_path / "a.json").read_text())["candidates"][0]["points"] == 10_000


def test_tiles_refuse_meshes(files, tmp_path):
    reference, mesh = files
    with check_error():
        compare(reference, mesh, Settings("none"), tiling=TilingSettings(5000, workers=1), workspace=tmp_path / "work")
    with check_error():
        compare(mesh, reference, tiling=TilingSettings(5000, workers=1), workspace=tmp_path / "work")


def test_info_says_why_a_mesh_is_not_closed(tmp_path, run):
    (tmp_path / "closed.stl").write_bytes(CUBES["binary.stl"])
    (tmp_path / "open.off").write_bytes(CUBES["plain.off"].replace(b"8 12 0", b"8 11 0").rsplit(b"\n", 2)[0] + b"\n")
    for name in ("closed.stl", "open.off"):
        check_text(run("info", tmp_path / name)[1].splitlines()[1])
