"""Calls from programs: clouds, arrays and paths as inputs, settings by name, and the repr of results."""

from pathlib import Path

import numpy as np
import pytest
from wording import check_error, check_text

import pcbench
from pcbench import Cloud, PcbenchError, Settings
from pcbench.report.answer import answer


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Return three samples of a bowl as arrays, also written as files of several kinds to the current folder."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    arrays = {}
    for name in ("ref.ply", "a.xyz", "b.npy"):
        plane = rng.uniform(-1, 1, (400, 2))
        arrays[name] = np.column_stack([plane, 0.3 * np.square(plane).sum(axis=1)])
        pcbench.write_cloud(name, arrays[name])
    return arrays


def test_paths_are_accepted_as_clouds(files, tmp_path):
    comparison = pcbench.compare("ref.ply", ["a.xyz", tmp_path / "b.npy"], register="none")
    assert [candidate.name for candidate in comparison] == ["a", "b"]
    assert comparison.inputs.reference.path == "ref.ply"
    assert comparison.inputs.candidates["b"].path == str(tmp_path / "b.npy")
    assert len(comparison.inputs.candidates["a"].sha256) == 64
    clouds = [pcbench.read_cloud(name) for name in ("ref.ply", "a.xyz", "b.npy")]
    cloud_comparison = pcbench.compare(clouds[0], clouds[1:], register="none")
    assert cloud_comparison.inputs is None
    for from_path, from_cloud in zip(comparison, cloud_comparison, strict=True):
        assert from_path.metrics.d1_mse == from_cloud.metrics.d1_mse
    from_path, from_cloud = pcbench.register("ref.ply", "a.xyz"), pcbench.register(clouds[0], clouds[1])
    np.testing.assert_array_equal(from_path.T_reference_candidate.matrix, from_cloud.T_reference_candidate.matrix)
    assert len(pcbench.crop("ref.ply", "box:-1,-1,-1,0,1,1")) == int((files["ref.ply"][:, 0] <= 0).sum())
    path_deformation, cloud_deformation = pcbench.deform("ref.ply", "a.xyz")[1], pcbench.deform(clouds[0], clouds[1])[1]
    assert path_deformation.sentence("a", "") == cloud_deformation.sentence("a", "")


def test_candidates_of_all_kinds_have_names(files):
    comparison = pcbench.compare("ref.ply", ["a.xyz", files["b.npy"]], register="none")
    assert [candidate.name for candidate in comparison] == ["a", "candidate_2"]
    assert [c.name for c in pcbench.compare("ref.ply", "a.xyz", register="none")] == ["a"]
    assert [c.name for c in pcbench.compare("ref.ply", {"mine": "a.xyz"}, register="none")] == ["mine"]
    pcbench.write_cloud("candidate_2.ply", "a.xyz")
    with check_error():
        pcbench.compare("ref.ply", ["candidate_2.ply", files["b.npy"]])


def test_a_mesh_by_its_path_is_a_mesh(files, tmp_path, monkeypatch):
    monkeypatch.setattr("pcbench.geometry.mesh_samples.REFERENCE_SAMPLES", 1000)
    (tmp_path / "box.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3 4\n")
    assert pcbench.compare("box.obj", "a.xyz", register="none").reference.faces == 2


def test_points_dropped_by_readers_give_a_warning(files):
    with Path("a.xyz").open("a") as file:
        file.write("nan nan nan\n")
    with pytest.warns(UserWarning) as records:
        comparison = pcbench.compare("ref.ply", "a.xyz", register="none")
    (text,) = comparison.inputs.candidates["a"].warnings
    check_text(text, masked=False)
    check_text("\n".join(str(warning.message) for warning in records))


def test_a_report_of_paths_can_be_repeated(files, tmp_path):
    comparison = pcbench.compare("ref.ply", "a.xyz", register="none")
    comparison.save("report", figures=False)
    assert (tmp_path / "report" / "settings.json").is_file()
    with check_error(PcbenchError):
        pcbench.compare("no-such.ply", "a.xyz")


def test_settings_by_name(files):
    comparison = pcbench.compare("ref.ply", "a.xyz", register="none", seed=5, thresholds=[0.1])
    settings = comparison.settings
    assert (settings.register, settings.seed, settings.thresholds) == ("none", 5, (0.1,))
    overridden = pcbench.compare("ref.ply", "a.xyz", Settings(register="none", seed=5), seed=6)
    assert (overridden.settings.register, overridden.settings.seed) == ("none", 6)
    with check_error():
        pcbench.compare("ref.ply", "a.xyz", registr="none")


def test_arrays_and_paths_are_written_like_clouds(files, tmp_path):
    pcbench.write_cloud("c.ply", "b.npy")
    np.testing.assert_array_equal(pcbench.read_cloud("c.ply").points, files["b.npy"])
    pcbench.write_cloud("d.xyz", files["b.npy"][:2].tolist())
    assert len(pcbench.read_cloud("d.xyz")) == 2
    with check_error():
        pcbench.write_cloud("e.ply", np.zeros((3, 2)))
    assert not (tmp_path / "e.ply").exists()


def test_a_comparison_has_a_short_repr(files):
    """The answer is first; more than two candidates are only named."""
    candidates = [files["a.xyz"], files["b.npy"], files["b.npy"]]
    for count in (2, 3):
        comparison = pcbench.compare(Cloud(files["ref.ply"], unit="m"), candidates[:count], register="none")
        sentence, *rest = check_text(repr(comparison)).splitlines()
        assert sentence.removeprefix("Comparison: ").removesuffix(".") in answer(comparison)[0]
        assert len(rest) == {2: 2, 3: 1}[count]
        assert max(map(len, rest)) < 120
    assert repr(comparison["candidate_1"]) == str(comparison.candidates[0])  # no arrays
    assert len(repr(comparison["candidate_1"]).splitlines()) == 1
