"""`pcbench experiment gao`: what it says of figures that are known, its table and pictures, and all of it on a city."""

import csv
import json
import math
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from command_line import one_line
from scene_folders import orbit, ten_pictures

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.deformation import Amplitude, Bin, Deformation, Growth, Trend
from pcbench.errors import InputError, Notice
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.transform import Similarity, fit_similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.measure.images import ViewScores
from pcbench.measure.presets import Gao2025
from pcbench.report import Figures, to_json
from pcbench.scenes.synthetic import city
from pcbench.scenes.synthetic.rigs import Site, rig
from pcbench.scenes.synthetic.warp import turn, warp_of
from pcbench.studies.gao.cameras import bent_by, camera_errors, seen_through
from pcbench.studies.gao.figures import pictures
from pcbench.studies.gao.held import hold, visible_truth
from pcbench.studies.gao.plan import MEANS, MVS, SPARSE, SURFACE, GaoJob, looked_at, methods, region_of
from pcbench.studies.gao.results import (
    SCHEMA,
    TRUTH,
    Against,
    CameraErrors,
    CloudResult,
    NewViews,
    SceneResult,
    Study,
    document,
    read_study,
)
from pcbench.studies.gao.sentences import sentences
from pcbench.studies.gao.table import cost_table, csv_text, failures, markdown, measures_table
from reconstructors.sfm.alignment import moved

K = Intrinsics.from_fov(320, 180, 40.0)


def points_of(path):
    return read_cloud(path).points


def verdict(word, rms=0.01, slope=0.0):
    rows = tuple(Bin(10.0 * k, slope * 10 * k, (-0.01, 0.01), 0.02) for k in range(5))
    trend = Trend(slope, (slope - 1e-3, slope + 1e-3), rows)
    model = "cubic" if word == "non-affine" else "rigid"
    return Deformation(
        word, model, amplitude=Amplitude(rms, 2 * rms, 3 * rms, (0.9 * rms, 1.1 * rms)), growth=Growth(trend, trend)
    )


def against(reference, forth, back, bend=None):
    """RMS lengths both ways."""
    measures = Gao2025(forth**2, 0.5 * forth**2, 0.4 * forth**2 if reference == MVS else None, 3.0, forth**2 + back**2)
    return Against(reference, 900, measures, 0.001, bend or verdict("none"))


def scene(name="city_1", bends=(), truth=True, factor=1.0, **changes):
    """Sparse far from all of the reference, means near but off, the surface near and on; bends by cloud, reference."""
    bends = dict(bends)

    def cloud(cloud_name, forth, back, off, seconds, **more):
        held = [] if cloud_name == MVS else [(MVS, forth, back)]
        held += [(TRUTH, math.hypot(forth, off), math.hypot(back, off))] if truth else []
        found = tuple(against(r, factor * f, factor * b, bends.get((cloud_name, r))) for r, f, b in held)
        return CloudResult(cloud_name, 1000, seconds, False, 2**28, against=found, **more)

    clouds = (
        cloud(SPARSE, 0.1, 2.0, 0.1, 30.0),
        cloud(MVS, 0.1, 0.2, 0.1, 100.0),
        cloud(MEANS, 0.4, 0.5, 0.1, 300.0),
        cloud(SURFACE, 0.2, 0.3, 0.1, 10.0, extra=True),
    )
    views = NewViews(ViewScores(30.0, 0.9), ViewScores(25.0, 0.8), 35, 5, 0.5)
    references = {MVS: (5000, 4000), **({TRUTH: (9000, 8000)} if truth else {})}
    rings = tuple((10 * math.cos(a), 10 * math.sin(a), 5.0 + a) for a in np.linspace(0, 6, 12))
    errors = CameraErrors(40, 40, 0.1, 0.3, 1.001, 0.5, 0.25)
    made = SceneResult(
        name, f"/x/{name}", "m", 40, rings, (0.0, 0.0, 2.0), "sphere:0,0,2,50", errors, references, clouds, views
    )
    return replace(made, **changes)


def study(*scenes, poses="solve"):
    found = Study(poses, {"steps": "2000", "density": "classic"}, scenes, provenance={})
    return replace(found, sentences=tuple(sentences(found)))


def said(*scenes, **more):
    return " ".join(study(*scenes, **more).sentences)


def test_gains_and_costs_follow_the_figures():
    words = said(scene())
    assert words.startswith("Densification makes 1,000 points of 1,000 (1 times as many). ")
    assert "It gains completeness: mvs to cloud (r→c), 2 m RMS becomes 0.5 m (4 times less)." in words
    assert "It costs accuracy: cloud to mvs (c→r), 0.1 m RMS becomes 0.4 m (4 times as much)." in words
    assert "Against the truth it costs accuracy: cloud to truth (c→r), 0.141 m RMS becomes 0.412 m" in words
    assert "instead of their centres, against truth: c→r 0.412 m RMS becomes 0.224 m (1.8 times less)" in words
    assert "30 s sparse, 100 s more for mvs, 300 s more for splats (3 times mvs); memory up to 256, 256" in words
    assert "at 25.0 dB PSNR, those that were at 30.0 dB: a gap of 5.0 dB" in words
    assert "trained for 2,000 steps (density=classic)" in words
    # The other way round: means that are nearer than the sparse points, and miss more.
    sparse, mvs, means, surface = scene().clouds
    turned = replace(
        scene(), clouds=(replace(means, name=SPARSE), mvs, replace(sparse, name=MEANS), replace(surface, name=SURFACE))
    )
    words = said(turned)
    assert "It loses completeness: mvs to cloud (r→c), 0.5 m RMS becomes 2 m" in words
    assert "It gains accuracy" in words
    same = replace(scene(), clouds=(replace(means, name=SPARSE), mvs, means, surface))
    assert "It gains no completeness" in said(same)
    assert "It costs no accuracy" in said(same)


def test_several_scenes_are_averaged_and_counted():
    sparse, mvs, means, surface = scene().clouds
    odd = replace(scene("b"), clouds=(replace(means, name=SPARSE), mvs, replace(sparse, name=MEANS), surface))
    words = said(scene("a"), scene("c", factor=4.0), odd)
    # Geometric means: 2, 8 and 0.5 m become 0.5, 2 and 2 m.
    assert "(r→c), 2 m RMS becomes 1.26 m (1.6 times less, in 2 of 3 scenes)" in words


def test_what_a_reference_of_the_same_images_hides():
    words = said(scene())
    assert "mvs is 0.141 m RMS off the truth (c→r), and the truth that cameras saw is 0.224 m RMS from it" in words
    assert "By the truth sparse is worse than mvs says: c→r 0.1 m RMS becomes 0.141 m" in words
    assert "By the truth splat-means is as far off as mvs says" in words
    ranked = (
        "mvs ranks splat-surface before splat-means before sparse, and the truth gives the same order; with mvs among"
    )
    assert ranked in words
    assert "them: mvs before splat-surface before splat-means before sparse." in words
    assert "The truth is not known" in said(scene(truth=False))


BENT = verdict("non-affine", 0.2, slope=0.004)
LARGE = verdict("non-affine", 0.6)


@pytest.mark.parametrize(
    ("bends", "words"),
    [
        (
            {},
            "solved cameras are 0.1 m (median) to 0.3 m from those of the scene, with 1.0010 times their focal length;"
            " by themselves they deform the surface by 0.5 m RMS beyond a rigid motion, and bend it by 0.25 m beyond an"
            " affine one, in every cloud alike.",
        ),
        (
            {(SPARSE, TRUTH): BENT, (MVS, TRUTH): BENT, (MEANS, TRUTH): LARGE},
            "the bend of sparse and mvs against the truth is no more than what the cameras do; mvs as the reference"
            " does not show that of sparse. the bend of splat-means against the truth is more than what the cameras do",
        ),
        (
            {(MEANS, TRUTH): BENT, (MEANS, MVS): BENT},
            "splat-means and mvs have the same cameras, so cameras are not what bends it against mvs; against the truth"
            " splat-means is bent and mvs is not.",
        ),
        (
            {(SURFACE, MVS): BENT, (MEANS, MVS): BENT, (MVS, TRUTH): BENT},
            "splat-means, splat-surface and mvs have the same cameras, so cameras are not what bends them against mvs;"
            " against the truth mvs is bent and splat-means does not show it; against the truth mvs is bent and",
        ),
        (
            {(SURFACE, MVS): BENT, (MVS, TRUTH): verdict("undecided"), (SURFACE, TRUTH): BENT},
            "against the truth it cannot be told which of the two it is. the bend of splat-surface against the truth",
        ),
    ],
)
def test_where_a_bend_comes_from(bends, words):
    assert words in said(scene(bends=bends))


def test_true_cameras_bend_nothing():
    words = said(scene(bends={(SPARSE, TRUTH): BENT}, cameras=None), poses="given")
    assert "the bend of sparse against the truth is more than what the cameras do" in words
    assert "solved cameras" not in words


def test_verdicts_in_words():
    bends = {
        (SPARSE, MVS): verdict("undecided").with_warnings([Notice("few", "too few")]),
        (MEANS, MVS): BENT,
        (SURFACE, MVS): verdict("affine"),
    }
    words = said(scene(bends=bends, truth=False))
    assert (
        "against mvs, splat-means is bent by 0.2 [0.18, 0.22] m RMS (rising by 4 ‰ with distance and rising by 4 ‰ with"
        " height); splat-surface is stretched, not bent; sparse: undecided (too few)." in words
    )
    assert "whether cameras bend both cannot be told without a truth" in words


def test_what_fails_is_a_row_and_a_sentence():
    sparse, mvs, _, surface = scene().clouds
    broken = replace(
        scene(),
        clouds=(
            sparse,
            mvs,
            CloudResult(MEANS, failure="out of memory"),
            replace(surface, against=(Against(MVS, failure="too few points"), *surface.against[1:])),
        ),
        views=None,
    )
    found = study(broken, scene("city_2"))
    assert found.sentences[:2] == (
        "city_1 splat-means failed: out of memory",
        "city_1 splat-surface could not be measured against mvs: too few points",
    )
    assert list(failures(found)) == list(found.sentences[:2])
    rows = {(row[0], row[1]): row for row in measures_table(found)}
    assert rows[("city_1 splat-means", "failed")]
    assert rows[("city_1 splat-surface", MVS)][3] == "failed"
    assert "4 times less" in " ".join(found.sentences)  # the other scene still counts
    lost = [row for row in csv.DictReader(csv_text(found).splitlines()) if row["failure"]]
    assert [(row["cloud"], row["failure"]) for row in lost] == [(MEANS, "out of memory"), (SURFACE, "too few points")]


def test_tables():
    found = study(scene())
    header, *rows = measures_table(found)
    assert all(len(row) == len(header) for row in rows)
    assert [(row[0], row[1]) for row in rows[:3]] == [(SPARSE, MVS), (MEANS, MVS), (SURFACE, MVS)]
    assert [row[0] for row in rows[3:]] == [SPARSE, MVS, MEANS, SURFACE]
    first = dict(zip(header, rows[0], strict=True))
    assert (first["points"], first["after crop"]) == ("1,000", "900")
    # Mean squares: 0.1 and 2 m.
    assert (first["D1 c→r"], first["D1 r→c"], first["Chamfer"], first["Hausdorff"]) == ("0.01", "4", "4.01", "3")
    assert first["bend RMS"] == "0.01 [0.009, 0.011]"
    assert dict(zip(header, rows[3], strict=True))["D2 mesh"] == "–"  # there is no Poisson mesh of the truth
    took = {
        row[0]: row[2]
        for row in cost_table(study(scene(clouds=(replace(scene().clouds[0], resumed=True), *scene().clouds[1:]))))
    }
    assert took == {"": "seconds", SPARSE: "≥ 30", MVS: "100", MEANS: "300", SURFACE: "+ 10"}
    read = list(csv.DictReader(csv_text(found).splitlines()))
    assert len(read) == 7
    assert float(read[0]["d1_back_mse"]) == pytest.approx(4.0)
    text = markdown(found, None)
    assert text.count("\n| ") == 2 + 8 + 5
    assert "sparse, against mvs" in text


def stored(folder, found):
    folder.mkdir(exist_ok=True)
    (folder / "experiment.json").write_text(to_json(document(found)))
    (folder / "gao.md").write_text(markdown(found, None))
    return folder


def test_a_study_is_read_as_it_was_written(tmp_path):
    found = study(scene(bends={(MEANS, MVS): BENT}), scene("b", truth=False, views=None, cameras=None, looked_at=None))
    again = read_study(stored(tmp_path / "a", found))
    assert tuple(sentences(again)) == found.sentences
    assert again == found
    (tmp_path / "a/experiment.json").write_text(json.dumps({"schema": "pcbench.experiment.bend/1"}))
    with pytest.raises(InputError, match="expected the schema"):
        read_study(tmp_path / "a")
    (tmp_path / "a/experiment.json").write_text(json.dumps({"schema": SCHEMA, "scenes": [{}]}))
    with pytest.raises(InputError, match="damaged"):
        read_study(tmp_path / "a")


def test_pictures(tmp_path, run):
    pytest.importorskip("matplotlib")
    image_of = pytest.importorskip("PIL.Image").open
    folder = stored(tmp_path / "a", study(scene(bends={(MEANS, MVS): BENT})))
    assert run("plot", folder, "rings")[:2] == (0, f"{folder}/figures/rings.png\n")
    drawn = pictures(folder, Figures())
    assert sorted(drawn) == ["directions", "growth", "rings"]
    for name in ("directions", "growth"):
        assert drawn[name].draw(folder / f"figures/{name}.png")
    for name, color in (("directions", (0xD5, 0x5E, 0)), ("growth", (0xD5, 0x5E, 0)), ("rings", (0, 0x72, 0xB2))):
        pixels = np.asarray(image_of(folder / f"figures/{name}.png").convert("RGB")).astype(int)
        assert (np.abs(pixels - color).max(axis=2) < 12).sum() > 200, name
    lost = tuple(CloudResult(name, failure="no features") for name in (SPARSE, MVS, MEANS, SURFACE))
    empty = stored(tmp_path / "b", study(scene(references={}, clouds=lost, views=None)))
    assert not pictures(empty, Figures())["directions"].draw(tmp_path / "none.png")


def test_the_region_is_about_what_cameras_look_at():
    cameras = rig("circles", 14, Site(100.0, 2.0, 30.0), K)
    np.testing.assert_allclose(looked_at(cameras), [0, 0, 16], atol=1e-9)
    x, y, z, radius = map(float, region_of(cameras).removeprefix("sphere:").split(","))
    assert (x, y, z) == (0, 0, 16)
    farthest = max(np.linalg.norm(camera.position - [0, 0, 16]) for camera in cameras)
    assert radius == pytest.approx(0.4 * farthest, abs=1e-3)
    down = [Camera(f"{k}.png", K, look_at([10.0 * k, 0, 50], [10.0 * k, 0, 0], up=[0, 1, 0])) for k in range(4)]
    assert looked_at(down) is None
    assert region_of(down) == "quantile:0.5"
    outward = [Camera(c.name, K, look_at(c.position, 2 * c.position)) for c in orbit([f"{k}.png" for k in range(6)])]
    assert looked_at(outward) is None


def cameras_with(move):
    true = {camera.name: camera for camera in rig("circles", 28, Site(100.0, 0.0, 20.0), K)}
    return {name: move(camera) for name, camera in true.items()}, true


def test_what_cameras_do_to_what_they_see():
    points = city(0).sample(4000, np.random.default_rng(0))[0]
    surface = Cloud(points[np.linalg.norm(points, axis=1) < 40])
    motion = Similarity(turn((3, 5, 20), (1, 2, 3), 1.0).rotation, np.array([3.0, -2.0, 1.0]), 1.03)
    solved, true = cameras_with(lambda camera: moved(camera, motion))
    placed, known = seen_through(solved, true, surface.points)
    assert known.mean() > 0.9
    np.testing.assert_allclose(placed[known], motion.apply(surface.points[known]), atol=1e-8)
    small = Similarity(np.eye(3), np.array([0.3, 0.2, -0.1]), 1.01)
    deformed, bent = bent_by(*cameras_with(lambda camera: moved(camera, small)), surface)
    assert bent < 1e-9  # another scale is no bend, but no rigid motion either
    assert deformed == pytest.approx(0.01 * np.std(surface.points[known] - surface.points[known].mean(0)), rel=0.05)

    # A lens taken for longer than it is, by two fits of another kind: Kabsch, and an affine map an axis.
    longer = replace(K, fx=1.02 * K.fx, fy=1.02 * K.fy, distortion=(0.02, 0.0, 0.0, 0.0))
    wrong, true = cameras_with(lambda camera: replace(camera, intrinsics=longer))
    deformed, bent = bent_by(wrong, true, surface)
    placed, known = seen_through(wrong, true, surface.points)
    before, after = surface.points[known], placed[known]
    rigid = fit_similarity(before, after, with_scale=False).apply(before) - after
    assert deformed == pytest.approx(np.sqrt(np.mean(rigid**2)), rel=0.01)
    columns = np.column_stack([before, np.ones(len(before))])
    rest = after - columns @ np.linalg.lstsq(columns, after, rcond=None)[0]
    assert bent == pytest.approx(np.sqrt(np.mean(rest**2)), rel=1e-6)
    assert 0.01 < bent < deformed
    up = Cloud(surface.points, normals=np.tile([0.0, 0.0, 1.0], (len(surface), 1)))
    assert bent_by(wrong, true, up)[1] == pytest.approx(np.sqrt(np.mean(rest[:, 2] ** 2)), rel=1e-6)

    errors = camera_errors(wrong, true, surface)
    assert (errors.solved, errors.given, errors.median, errors.bent) == (28, 28, pytest.approx(0, abs=1e-9), bent)
    assert errors.focal_ratio == pytest.approx(1.02)
    assert camera_errors(wrong, true, None).bent is None
    assert camera_errors(dict(list(wrong.items())[:2]), true, surface) is None


def test_clouds_are_held_against_a_reference_and_kept(tmp_path):
    """As `compare` does it: the bent one is bent, the one from nowhere is a failure, and none of it is done twice."""
    rng = np.random.default_rng(0)

    def sample(count, bend=0.0):
        points, _ = city(0).sample(count, rng)
        points = points + rng.normal(0, 0.03, points.shape)
        return warp_of("dome", points, bend).apply(points) if bend else points

    for name, points in {
        "reference": sample(20_000),
        "straight": sample(6000),
        "bent": sample(6000, 0.5),
        "nowhere": rng.normal(size=(5, 3)),
    }.items():
        write_cloud(tmp_path / f"{name}.ply", Cloud(points, unit="m"))
    clouds = {name: tmp_path / f"{name}.ply" for name in ("straight", "bent", "nowhere")}
    region = "sphere:0,0,0,150"
    found = hold(tmp_path / "reference.ply", TRUTH, clouds, region, tmp_path, 0)
    inside = np.linalg.norm(points_of(tmp_path / "reference.ply"), axis=1) <= 150
    assert found.counts == (20_000, inside.sum())
    straight, bent = found.clouds["straight"], found.clouds["bent"]
    assert (straight.deformation.verdict, bent.deformation.verdict) == ("none", "non-affine")
    assert straight.measures.d2_poisson_mse is None
    assert straight.measures.d2_mse < bent.measures.d2_mse
    assert 0 < straight.back_mse < straight.measures.chamfer
    assert "expected" in found.clouds["nowhere"].failure
    stamp = (found.folder / "comparison.json").stat().st_mtime_ns
    again = hold(tmp_path / "reference.ply", TRUTH, clouds, region, tmp_path, 0)
    assert again == found
    assert (again.folder / "comparison.json").stat().st_mtime_ns == stamp
    # Another question is asked anew.
    assert hold(tmp_path / "reference.ply", TRUTH, {"nowhere": clouds["nowhere"]}, region, tmp_path, 0) is None


def test_the_truth_is_what_cameras_saw(tmp_path):
    points = np.arange(30.0).reshape(10, 3)
    write_cloud(tmp_path / "cloud.ply", Cloud(points, attributes={"visible": (np.arange(10) < 4).astype(np.uint8)}))
    assert len(points_of(visible_truth(tmp_path / "cloud.ply", tmp_path))) == 4
    write_cloud(tmp_path / "cloud.ply", Cloud(points))
    assert len(points_of(visible_truth(tmp_path / "cloud.ply", tmp_path))) == 10


def test_the_paper_s_settings_are_those_of_the_clouds():
    plan = {method.name: method for method in methods(GaoJob(settings={"steps": "7", "density": "gao2025"}))}
    assert plan[SPARSE].settings["poses"] == "solve"
    assert plan[MVS].settings["poses"] == "given"
    means, surface = plan[MEANS], plan[SURFACE]
    assert means.workspace == surface.workspace
    assert {k for k in means.settings if means.settings[k] != surface.settings[k]} == {"cloud"}
    assert (means.settings["start"], means.settings["steps"], means.settings["density"]) == ("sfm", "7", "gao2025")


def test_what_cannot_be_run_is_refused(run, tmp_path):
    pytest.importorskip("pycolmap")
    pytest.importorskip("torch")
    bare = ten_pictures(tmp_path / "bare")
    few = ten_pictures(tmp_path / "few")
    for k in range(8, 10):
        (few / f"images/{k}.png").unlink()
    write_colmap_model(few / "sparse/0", orbit([f"{k}.png" for k in range(8)]))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    for arguments, message in (
        ((bare,), "has no camera: the experiment needs them"),
        ((few,), "expected at least 9 images"),
        ((bare, "--images", "20"), "are those of cities, made where no SCENE is given"),
        (("--image-scale", "0.5"), "cities are photographed at --size"),
        (("--set", "cloud=means"), "settings of splat that the experiment leaves open, got cloud"),
        (("--set", "hold_out=none"), "new views are measured too"),
    ):
        code, _, err = run("experiment", "gao", *arguments, "--out", tmp_path / "out")
        assert code == 2
        assert message in err
        assert one_line(err)
    code, _, err = run("experiment", "gao", "--out", tmp_path / "mine")
    assert code == 2
    assert "holds no such experiment" in err


SMALL = ("--cities", "1", "--images", "28", "--size", "240x136", "--extent", "100", "--poses", "given")


@pytest.mark.slow
def test_a_small_experiment(run, renderer, tmp_path):
    """Killed once, with a training that is refused once: what was made stays, and what failed is said."""
    pytest.importorskip("pycolmap")
    pytest.importorskip("torch")
    pytest.importorskip("matplotlib")
    out = tmp_path / "gao"
    refused = ("experiment", "gao", "--out", out, *SMALL, "--set", "memory=0.001")
    killed_when(["pcbench.cli", *map(str, refused)], out / "city_1/runs/sparse/stage.json")
    first = (out / "city_1/runs/sparse/stage.json").stat().st_mtime_ns
    assert not (out / "experiment.json").exists()

    code, said, err = run(*refused)
    assert code == 0, err
    assert "splat-means failed: " in said
    assert "memory=0.001 allows less" in said
    found = read_study(out)
    assert [bool(cloud.failure) for cloud in found.scenes[0].clouds] == [False, False, True, True]
    assert found.scenes[0].views is None
    assert "mvs is 0." in said  # what could be measured was

    code, said, err = run("experiment", "gao", "--out", out, *SMALL, "--set", "steps=700")
    assert code == 0, err
    assert (out / "city_1/runs/sparse/stage.json").stat().st_mtime_ns == first
    (scene,) = read_study(out).scenes
    assert scene.references[TRUTH][1] > scene.references[MVS][1] / 100 > 0
    assert all(not cloud.failure for cloud in scene.clouds)
    sparse, mvs, means, surface = scene.clouds
    assert means.points > 1.2 * sparse.points  # it was densified
    assert surface.seconds < means.seconds  # and trained once
    assert mvs.held(TRUTH).back_rms < sparse.held(TRUTH).back_rms
    assert (scene.views.train_views, scene.views.test_views) == (24, 4)
    for name in ("rings", "directions", "growth"):
        assert (out / f"figures/{name}.png").stat().st_size > 10_000
    for name in (SPARSE, MEANS, SURFACE):
        assert (out / f"city_1/against-mvs/figures/{name}_poisson_distance.png").stat().st_size > 10_000
    assert (out / "views/figures/city_1_splat.png").stat().st_size > 10_000
    written = {path: path.read_bytes() for path in (out / "experiment.csv", out / "gao.md")}
    assert run("experiment", "gao", "--out", out, *SMALL, "--set", "steps=700")[:2] == (0, said)
    assert all(path.read_bytes() == text for path, text in written.items())


def killed_when(module, file, seconds=300.0):
    """Run `python -m MODULE ...` and kill it as soon as the file is there."""
    process = subprocess.Popen([sys.executable, "-m", *module], stdout=subprocess.DEVNULL)
    end = time.monotonic() + seconds
    while not file.exists():
        assert process.poll() is None, "it ended before it was killed"
        assert time.monotonic() < end
        time.sleep(0.05)
    process.kill()
    process.wait()
