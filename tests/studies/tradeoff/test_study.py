"""`pcbench tradeoff`: biases in closed form, reproducible seeds, files, resumed runs, and skipped approximations."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import shapes
from html_pages import check_page_of_study, markdown_tables
from optional import break_library, import_or_skip
from wording import check_error, check_text

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.report.plot import draw
from pcbench.studies.tradeoff import approximations, runs
from pcbench.studies.tradeoff.charts import PICTURES
from pcbench.studies.tradeoff.metrics import CORRECTABLE, MEANS
from pcbench.studies.tradeoff.recommend import recommend
from pcbench.studies.tradeoff.results import KIND, TradeoffSettings
from pcbench.studies.tradeoff.study import make_pair, run_tradeoff
from pcbench.studies.tradeoff.words import warnings

LEVELS = (0.25,)


def plane_pair():
    return shapes.plane_samples(8000, seed=1), shapes.plane_samples(3000, seed=2)


def city_pair(points=1200):
    rng = np.random.default_rng(0)
    reference, candidate = shapes.city(2 * points, seed=1)[0], shapes.city(points, seed=2)[0]
    return Cloud(reference, unit="m"), Cloud(candidate + rng.normal(0, 0.02, candidate.shape))


@pytest.fixture(scope="module")
def plane_study():
    settings = TradeoffSettings(levels=LEVELS, seeds=3, only=("random",), register="none")
    return run_tradeoff(*plane_pair(), settings).study


@pytest.mark.long
def test_thinning_a_plane_doubles_the_distance_to_it(plane_study):
    """The mean distance to a Poisson process of density q on a plane is 1 / (2 sqrt(q)): at a quarter it doubles."""
    assert plane_study.exact.values["mean c→r"] == pytest.approx(0.5 / np.sqrt(8000 / 100), rel=0.05)
    for side, biased, unbiased in (("reference", "mean c→r", "mean r→c"), ("candidate", "mean r→c", "mean c→r")):
        row = plane_study.row(f"random {side} 25 %")
        # Of 3,000 distances the mean has a standard error of 1 %; the border adds some percent.
        assert row.errors[biased].mean == pytest.approx(1.0, abs=0.1)
        assert abs(row.errors[unbiased].mean) < 0.05
        # 750 thinned points give distance and floor a standard error of 2 % each. The correction multiplies that of the
        # square by 1 / share = 4: 11 % of the corrected distance, 6 % of the mean of three runs.
        assert abs(row.corrected[biased].mean) < 0.2
    both = plane_study.row("random both 25 %")
    assert both.errors["Chamfer"].mean == pytest.approx(1.0, abs=0.1)
    assert abs(both.corrected["Chamfer"].mean) < 0.2


@pytest.mark.usefixtures("without_deformation")
def test_seeds_are_reproducible():
    clouds = city_pair(200)
    settings = TradeoffSettings(levels=LEVELS, seeds=3, only=("random both",), register="none", seed=7)
    first, again = (run_tradeoff(*clouds, settings).study for _ in range(2))
    other = run_tradeoff(*clouds, replace(settings, seed=70)).study
    for one, two, three in zip(first.rows, again.rows, other.rows, strict=True):
        assert (one.errors, one.corrected) == (two.errors, two.corrected)
        assert one.errors["mean r→c"] != three.errors["mean r→c"]
    pair = make_pair(*clouds, settings)
    (disk,), _ = approximations.plan(pair, replace(settings, only=("disk cand",)))
    one, two, three = (runs._run(pair, disk, seed).values["mean r→c"] for seed in (7, 7, 70))
    assert one == two != three


@pytest.mark.long
def test_errors_stay_within_the_bounds_on_other_seeds():
    """Errors whose prediction interval is within the tolerance are within it with other seeds."""
    pair, settings = city_pair(1500), TradeoffSettings(tolerance=0.1, only=("random", "search"), seeds=5)
    study = run_tradeoff(*pair, settings).study
    within = [
        (row.name, corrected)
        for row in study.rows
        for corrected in (False, True)
        if (bound := row.group_bound(MEANS, corrected=corrected)) is not None and bound <= settings.tolerance
    ]
    assert within
    other = run_tradeoff(*pair, replace(settings, seed=50, only=tuple(name for name, _ in within))).study
    for name, corrected in within:
        errors = other.row(name).errors_with(corrected=corrected)
        assert all(abs(errors[metric].mean) <= settings.tolerance for metric in CORRECTABLE), name


@pytest.mark.long
def test_files_of_a_quick_study_and_resumed_runs(tmp_path, monkeypatch):
    import_or_skip("matplotlib")
    settings = TradeoffSettings.quick_plan()
    outcome = run_tradeoff(*city_pair(600), settings, out=tmp_path / "out")
    folder, study = tmp_path / "out", outcome.study
    assert KIND.read(folder) == replace(study, provenance=None)
    families = {row.family for row in study.rows}
    assert families == {
        "random",
        "voxel",
        "float32",
        "search",
        "normals",
    }  # 600 points are too few to register by fewer
    # float32 rounds by 1e-7 of 10 m.
    assert study.row("float32 stored").group_bound(MEANS) < 1e-4
    assert study.row("search within 1.5").errors["mean c→r"].mean >= 0
    rows = list(csv.DictReader((folder / "tradeoff.csv").read_text().splitlines()))
    assert {row["approximation"] for row in rows} == {row.name for row in study.rows}
    page = (folder / "tradeoff.md").read_text()
    assert all(sentence in page for sentence in study.sentences)
    for name in ("errors.png", "bias.png"):
        assert f"figures/{name}" in page and (folder / "figures" / name).stat().st_size > 10_000
    parsed = check_page_of_study((folder / "report.html").read_text(encoding="utf-8"))
    assert parsed.tables == markdown_tables(page) and len(parsed.values("src")) == 2
    assert json.loads((folder / "tradeoff.json").read_text())["schema"] == "pcbench.tradeoff/1"
    assert [path.name for path in draw(folder, ("bias.svg",), PICTURES)] == ["bias.svg"]

    monkeypatch.setattr(runs, "_run", lambda pair, approximation, seed: pytest.fail("run again"))
    again = run_tradeoff(*city_pair(600), settings, out=folder, figures=False)
    assert replace(again.study, provenance=None) == replace(study, provenance=None)


@pytest.mark.usefixtures("without_deformation")
def test_damaged_records_are_repeated_and_another_pair_is_refused(tmp_path):
    damages = ({"old_field": 1}, {"points": None}, {"values": {}}, {"cpu_s": 0}, {"seed": 70}, {"message": "x"})
    settings = TradeoffSettings(levels=LEVELS, seeds=len(damages), only=("random both",), register="none")
    first = run_tradeoff(*city_pair(200), settings, out=tmp_path / "out", figures=False).study
    paths = sorted((tmp_path / "out" / "runs").glob("random-both-25--_*.json"))
    records = [json.loads(path.read_text()) for path in paths]
    for path, record, damage in zip(paths, records, damages, strict=True):
        path.write_text(json.dumps({**record, **damage}))
    again = run_tradeoff(*city_pair(200), settings, out=tmp_path / "out", figures=False).study
    assert [row.errors for row in again.rows] == [row.errors for row in first.rows]
    for path, record in zip(paths, records, strict=True):
        assert json.loads(path.read_text())["values"] == record["values"]
    with check_error():
        run_tradeoff(*reversed(city_pair(200)), settings, out=tmp_path / "out")


@pytest.mark.usefixtures("without_deformation")
def test_an_exact_value_of_zero_has_no_relative_error():
    reference = shapes.city(1500)[0]
    settings = TradeoffSettings(
        tolerance=0.9, levels=(0.5,), seeds=3, only=("random reference", "local"), register="none"
    )
    study = run_tradeoff(reference, reference[::2], settings).study
    assert study.exact.values["mean c→r"] == 0
    assert study.row("random reference 50 %").errors["mean c→r"] is None
    assert study.row("random reference 50 %").group_bound(MEANS) is None
    # With equal times on every machine: only the correction, whose result is exactly 0, keeps this metric.
    cheap = replace(
        study,
        exact=replace(study.exact, cpu_spread=0.0),
        rows=[replace(row, cpu_ratio=0.5, cpu_ratio_max=0.5) for row in study.rows],
    )
    assert recommend(cheap, [MEANS]).corrected
    assert recommend(replace(cheap, rows=[replace(row, corrected={}) for row in cheap.rows]), [MEANS]).row is None
    check_text("\n".join(line for line in warnings(study) if "exact value" in line))


def test_an_exact_comparison_that_fails_ends_the_study_at_once(monkeypatch):
    calls = []
    measure = runs._run
    monkeypatch.setattr(runs, "_run", lambda *args: calls.append(args) or measure(*args))
    reference, candidate = city_pair(200)
    with check_error(InputError):
        run_tradeoff(reference, Cloud(candidate.points + 1e4), TradeoffSettings(only=("random",)))
    assert len(calls) == 1


@pytest.mark.usefixtures("without_deformation", "few_samples")
def test_samples_of_a_mesh_are_not_corrected_as_thinned_points():
    pair = make_pair(sphere_mesh(), shapes.fibonacci_sphere(500, 10.0)[0], TradeoffSettings(register="none"))
    (approximation, *_), _ = approximations.plan(pair, TradeoffSettings(only=("random candidate 50 %",)))
    run = runs._run(pair, approximation, 0)
    assert run.corrected["mean c→r"] == run.values["mean c→r"]  # the mesh is complete
    assert run.corrected["mean r→c"] < run.values["mean r→c"]


def test_foreign_folders_stay(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with check_error():
        run_tradeoff(*city_pair(200), out=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def sphere_mesh():
    """A tetrahedron's faces, divided four times, on a sphere of radius 10."""
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    triangles = corners[np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])]
    for _ in range(4):
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        triangles = np.concatenate(
            [np.stack(parts, axis=1) for parts in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    vertices, faces = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return Mesh(10 * vertices / np.linalg.norm(vertices, axis=1)[:, None], faces.reshape(-1, 3))


def test_a_missing_library_is_skipped_and_named(monkeypatch):
    pair = make_pair(sphere_mesh(), shapes.fibonacci_sphere(500, 10.0)[0], TradeoffSettings())
    monkeypatch.setattr(approximations, "find_spec", lambda name: None)
    found, skipped = approximations.plan(pair, TradeoffSettings(only=("random", "decimation")))
    assert {approximation.family for approximation in found} == {"random"}
    check_text("\n".join(skipped))


def test_a_broken_library_fails_its_runs_alone(monkeypatch, tmp_path):
    mesh, cloud = sphere_mesh(), Cloud(shapes.fibonacci_sphere(500, 10.0)[0])
    pair = make_pair(mesh, cloud, TradeoffSettings(register="none"))
    (approximation, *_), _ = approximations.plan(pair, TradeoffSettings(only=("decimation",)))
    break_library(monkeypatch, tmp_path, "pymeshlab")
    check_text(runs._run(pair, approximation, 0).message)


@pytest.mark.long
def test_decimation_of_a_mesh():
    import_or_skip("pymeshlab")
    settings = TradeoffSettings(levels=(0.25,), only=("decimation",), register="none")
    pair = make_pair(sphere_mesh(), shapes.fibonacci_sphere(3000, 10.0)[0], settings)
    (approximation,), _ = approximations.plan(pair, settings)
    run = runs._run(pair, approximation, 0)
    # A quarter of 1,024 faces has edges a of about 3.3: chords lie up to a^2 / 8R = 0.14 inside the sphere.
    assert run.message == "" and 0.01 < run.values["mean c→r"] < 0.3


def test_settings_and_pairs_that_cannot_be_used():
    for changes in ({"tolerance": 0.0}, {"levels": (1.0,)}, {"levels": ()}, {"seeds": 2}):
        with check_error():
            TradeoffSettings(**changes)
    with check_error():
        run_tradeoff(*city_pair(200), TradeoffSettings(only=("nothing",)))
    with check_error():
        run_tradeoff(np.zeros((1, 3)), np.zeros((5, 3)))
    with check_error():  # the reason is that the reference is no mesh
        run_tradeoff(*city_pair(200), TradeoffSettings(only=("decimation",)))


def test_an_approximation_that_fails_is_a_row_with_its_reason():
    reference, candidate = city_pair(60)
    study = run_tradeoff(reference, candidate, TradeoffSettings(only=("random both",), levels=(0.05,), seeds=3)).study
    (row,) = study.rows
    assert row.message and row.errors["mean c→r"] is None and row.group_bound(MEANS) is None
