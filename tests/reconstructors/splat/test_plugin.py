"""The reconstructor around the training: masks, keys of checkpoints, and the limit of memory."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import textured_corner as corner
from optional import import_or_skip
from PIL import Image
from wording import check_error, check_text

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import look_at
from pcbench.geometry.visibility import in_frame
from pcbench.io import read_cloud
from pcbench.scenes import read_scene
from pcbench.scenes.views import read_views

torch = import_or_skip("torch")

from reconstructors.sfm.features import NoPointsError  # noqa: E402
from reconstructors.splat import splat as plugin  # noqa: E402
from reconstructors.splat.exposure import read_gains  # noqa: E402
from reconstructors.splat.optimizer import LearningRates  # noqa: E402
from reconstructors.splat.recipes import RECIPES, SUPERVISED_RATES, Recipe  # noqa: E402
from reconstructors.splat.start import points_in_view  # noqa: E402
from reconstructors.splat.train import Schedule  # noqa: E402

QUICK_SETTINGS = {"supervision": "none", "steps": 12, "gaussians": 400, "sh_degree": 0, "cloud": "means"}


@pytest.fixture
def train(tmp_path, monkeypatch):
    """Train with settings on eight photographs, some of which are completely hidden by masks."""
    monkeypatch.setattr(plugin, "ColmapSfm", corner.RandomPointsSfm)
    folder = tmp_path / "corner"
    folder.mkdir()
    corner.write_scene(folder, corner.cameras(8, corner.standard_intrinsics(64, 48)))
    (tmp_path / "work").mkdir()

    def run(masked_images=(), **settings):
        masks = tmp_path / f"masks_{len(masked_images)}"
        masks.mkdir(exist_ok=True)
        for number in masked_images:
            Image.fromarray(np.zeros((48, 64), np.uint8)).save(masks / f"{number:03}.png.png")
        scene = read_scene(folder, masks=masks if masked_images else None)
        settings = {**QUICK_SETTINGS, "start": "sfm", **settings}
        return plugin.GaussianSplatting(**settings).reconstruct(scene, tmp_path / "work")

    return run


def add_a_ninth_photograph(folder):
    """Add a photograph, so that each 8th can be held out."""
    shutil.rmtree(folder)
    folder.mkdir()
    corner.write_scene(folder, corner.cameras(9, corner.standard_intrinsics(64, 48)))


def test_a_hidden_photograph_is_not_used_for_evaluation(train, tmp_path):
    assert "nan" not in " ".join(train(masked_images=[0, 3]).notes)
    assert "nan" not in (tmp_path / "work/model/curve.csv").read_text()
    with check_error():
        train(masked_images=range(8))


def test_a_checkpoint_of_other_photographs_is_not_resumed(train, monkeypatch):
    keys = []

    def interrupt(training, checkpoint, key, show):
        keys.append(key)
        raise InterruptedError

    monkeypatch.setattr(plugin, "run_with_checkpoints", interrupt)
    for masked_images in ((), (2,), ()):
        with pytest.raises(InterruptedError):
            train(masked_images)
    assert keys[0] == keys[2] != keys[1]


def test_too_little_memory_is_refused(train):
    with check_error():
        train(memory=1e-6)


def test_wrong_settings_are_refused_before_any_work(train, monkeypatch):
    with check_error(ValueError):
        train(cloud="surface", min_opacity=0.5)
    for settings in ({"start": "sfm"}, {"start": "mvs", "density": "fixed"}):
        with check_error(ValueError):
            train(select="surface", **settings)
    monkeypatch.setattr(corner.RandomPointsSfm, "reconstruct", lambda *_: pytest.fail("work was started"))
    with check_error():
        train(hold_out="every")


def test_a_note_tells_how_to_write_the_model_for_the_web(train, tmp_path, monkeypatch, run):
    (note,) = [note for note in train().notes if "pcbench convert" in note]
    monkeypatch.chdir(tmp_path)
    command = note.partition("for the web: pcbench ")[2].split()
    assert run(*command)[0] == 0
    assert len(read_cloud("model.spz")) == len(read_cloud(command[1]))


def test_the_note_moves_a_model_in_survey_coordinates_to_the_origin(train, monkeypatch):
    monkeypatch.setattr(plugin, "local_origin", lambda _: np.array([448000.0, 5419000.0, 0.0]))
    (note,) = [note for note in train().notes if "pcbench convert" in note]
    assert note.endswith("model.spz --shift -448000,-5419000,0")


def test_the_note_gives_the_last_step(train, monkeypatch):
    check_text(next(note for note in train(density="fixed").notes if note.endswith("after step 12")))
    converging = Recipe(schedule=Schedule(plateau=np.inf, downscale_shares=(0, 0)))
    monkeypatch.setitem(RECIPES, "fixed", converging)
    check_text(next(note for note in train(density="fixed", steps=100).notes if "after step 30 of 100" in note))


def test_a_note_reports_that_no_gaussian_is_added_to_few_points(train):
    def notes(**settings):
        return [note for note in train(**settings).notes if "few Gaussians" in note]

    (note,) = notes(density="fixed", gaussians=2000)
    assert "at the 400 points" in check_text(note)
    for density in ("classic", "parsimonious"):  # they add Gaussians
        assert not notes(density=density, gaussians=2000)
    assert not notes(density="fixed", gaussians=800)


def test_cameras_suffice_for_a_random_start(train, monkeypatch):
    """Photographs without features have no sparse points."""

    def find_nothing(*_):
        raise NoPointsError("no features")

    monkeypatch.setattr(corner.RandomPointsSfm, "reconstruct", find_nothing)
    check_text(next(note for note in train(start="random").notes if "no features" in note))
    for settings in ({"start": "sfm"}, {"start": "random", "poses": "solve"}):
        with pytest.raises(NoPointsError):
            train(**settings)


def test_random_points_are_where_three_cameras_look():
    cameras = corner.cameras(8, corner.standard_intrinsics(64, 48))
    points = points_in_view(cameras, 500, 0)
    views = sum(in_frame(camera, points).astype(int) for camera in cameras)
    assert points.shape == (500, 3) and views.min() >= 3
    assert np.mean(views) > 6  # all look at the corner
    backwards = [
        replace(camera, cam_from_world=look_at(camera.position, 2 * camera.position)) for camera in cameras[::4]
    ]
    with check_error(ReconstructionError):
        points_in_view(backwards, 500, 0)


def test_transparent_photographs_are_trained_and_rendered_as_such(train, tmp_path):
    """Photographs and renderings of `pcbench views` are over white, or over the color that is set."""
    add_a_ninth_photograph(tmp_path / "corner")
    for path in (tmp_path / "corner/images").iterdir():
        alpha = np.full((48, 64), 255, np.uint8)
        alpha[:, :20] = 0
        Image.fromarray(np.dstack([np.asarray(Image.open(path)), alpha])).save(path)
    settings = {"hold_out": "every", "density": "fixed", "steps": 200}
    for background, level in (("auto", 255), ("black", 0)):
        notes = train(background=background, **settings).notes
        check_text(next(note for note in notes if "transparent pixels" in note))
        views = read_views(tmp_path / "work")
        images = [view.read() for view in views.views]
        assert all(image.mask is None and (image.photograph[:, :20] == level).all() for image in images)
        # The upper left corner shows no plane.
        assert np.mean([np.abs(image.rendering[:10, :10].astype(int) - level) for image in images]) < 4
        model = tmp_path / "work/model/point_cloud.ply"
        assert f"comment background {level / 255:.4f}".encode() in model.read_bytes()[:500]


def test_different_exposures_are_compensated_and_a_note_gives_both_scores(train, tmp_path):
    add_a_ninth_photograph(tmp_path / "corner")
    for number, path in enumerate(sorted((tmp_path / "corner/images").iterdir())):
        if number % 2:
            Image.fromarray((0.6 * np.asarray(Image.open(path))).astype(np.uint8)).save(path)
    settings = {"hold_out": "every", "density": "fixed", "steps": 100}
    (note,) = [note for note in train(exposure=True, **settings).notes if "brightness of the photographs" in note]
    check_text(note)
    gains = read_gains(tmp_path / "work/model/gains.csv")
    assert list(gains) == [f"{number:03}.png" for number in range(1, 8)]
    dark, bright = (np.array(list(gains.values()))[parity::2] for parity in (0, 1))
    # The photographs differ by 0.6. Single gains also absorb what the model lacks after few steps.
    assert np.median(dark) < 0.8 * np.median(bright)
    assert not any("brightness" in note for note in train(**settings).notes)
    assert not (tmp_path / "work/model/gains.csv").exists()


def test_the_learned_background_is_a_note_and_stays_with_the_model(train, tmp_path):
    """The photographs' background is grey; a second run uses the finished model again."""
    add_a_ninth_photograph(tmp_path / "corner")
    texts = []
    for _ in range(2):
        reconstruction = train(background="learned", hold_out="every", density="fixed", steps=100)
        texts.append(next(note for note in reconstruction.notes if "Gaussians, learned" in note))
    assert check_text(texts[0]) == texts[1]
    color = np.loadtxt(tmp_path / "work/model/background.txt")
    assert texts[0].endswith("({}, {}, {})".format(*np.rint(255 * color).astype(int)))


def test_the_recipe_of_the_paper_is_used_unless_it_is_set_otherwise(train, monkeypatch):
    trained = []
    monkeypatch.setattr(plugin, "run_with_checkpoints", lambda training, *_: trained.append(training) or training.model)
    train(density="gao2025", steps=None, sh_degree=None, image_side=None, gaussians=None)
    (training,) = trained
    assert (training.schedule.steps, training.schedule.sh_degree) == (50_000, 3)
    assert [training.schedule.degree(step) for step in (999, 1000, 2999, 3000)] == [0, 1, 2, 3]
    assert training.schedule.level(0) == 0
    assert training.photographs[0][0].view.width == 16  # a quarter
    assert training.density.max_gaussians == 2_000_000
    train(density="gao2025", steps=30_000)
    assert trained[1].schedule.steps == 30_000


@pytest.mark.parametrize(
    ("settings", "is_faster"),
    [
        ({}, True),
        ({"density": "fixed"}, True),
        ({"density": "classic"}, False),
        ({"start": "sfm"}, False),
        ({"supervision": "none"}, False),
        ({"density": "gao2025"}, False),
    ],
    ids=str,
)
def test_gaussians_move_faster_only_where_depths_hold_them(settings, is_faster):
    rates = plugin.GaussianSplatting(**settings)._recipe.schedule.rates
    assert (rates == SUPERVISED_RATES) == is_faster
    usual = RECIPES[settings.get("density", "parsimonious")].schedule.rates
    assert is_faster or rates == usual
    assert SUPERVISED_RATES.means > LearningRates().means > RECIPES["gao2025"].schedule.rates.means


def test_a_note_reports_that_training_is_too_short_to_densify(train):
    (note,) = [note for note in train(density="classic").notes if "density=classic" in note]
    assert "at step 500" in check_text(note)
    assert not any("density=" in note for note in train(density="fixed").notes)
