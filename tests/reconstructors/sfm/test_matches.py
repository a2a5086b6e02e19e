"""Matching: the matches do not depend on how the work is split."""

import os
import sqlite3
import subprocess
import sys

import numpy as np
import pytest
from optional import import_or_skip
from PIL import Image
from wording import check_error

from pcbench.errors import ReconstructionError
from pcbench.scenes import read_scene
from pcbench.threads import ONE_THREAD
from reconstructors.sfm import matches
from reconstructors.sfm.features import DATABASE, extract_features
from reconstructors.sfm.match_child import match
from reconstructors.sfm.pairs import choose_pairs

pycolmap = import_or_skip("pycolmap")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Six crops of one random texture, shifted by 12 pixels each, with names that COLMAP's lists do not support."""
    folder = tmp_path_factory.mktemp("plane")
    blots = np.random.default_rng(0).integers(0, 256, (60, 84), dtype=np.uint8)
    picture = Image.fromarray(blots).resize((420, 300), Image.Resampling.BICUBIC)
    for k in range(6):
        picture.crop((12 * k, 6 * k, 12 * k + 340, 6 * k + 260)).save(folder / f"view {k}.png")
    return read_scene(folder)


@pytest.fixture(scope="module")
def features(scene, tmp_path_factory):
    return extract_features(scene, tmp_path_factory.mktemp("features"), 1500, upsample=False)


def _match_and_read(features, scene, workspace):
    """Return the table of matches and the images' names."""
    _, pairs = choose_pairs(scene, "exhaustive")
    folder = matches.match_pairs(features, pairs, workspace)
    database = sqlite3.connect(folder / DATABASE)
    rows = database.execute("SELECT pair_id, rows, data FROM matches ORDER BY pair_id").fetchall()
    names = [name for (name,) in database.execute("SELECT name FROM images ORDER BY image_id")]
    database.close()
    assert not list(folder.glob("part-*"))
    return rows, names


@pytest.mark.long
def test_matches_are_the_same_on_any_number_of_processes(features, scene, tmp_path, monkeypatch):
    monkeypatch.setattr(matches, "_MIN_PAIRS_PER_PROCESS", 4)
    results = []
    for count in (1, 3):
        monkeypatch.setattr(matches, "cpu_count", lambda count=count: count)
        (tmp_path / str(count)).mkdir()
        results.append(_match_and_read(features, scene, tmp_path / str(count)))
    assert results[0] == results[1]
    matches_of_pairs, names = results[0]
    assert len(matches_of_pairs) == 15
    assert names == list(scene.images)
    assert min(rows for _, rows, _ in matches_of_pairs) > 100  # all show most of the texture


def test_colmap_matches_with_one_thread(features, scene, tmp_path, monkeypatch):
    """Concurrent threads corrupt indices in about one of a hundred runs: too rare to test for directly."""
    thread_counts, environments = [], []
    run_module = matches.run_module

    def record_environment(*arguments, environment):
        environments.append(environment)
        return run_module(*arguments, environment=environment)

    monkeypatch.setattr(matches, "run_module", record_environment)
    _match_and_read(features, scene, tmp_path)
    assert environments == [ONE_THREAD]
    monkeypatch.setattr(
        pycolmap,
        "match_image_pairs",
        lambda *_, matching_options, **__: thread_counts.append(matching_options.num_threads),
    )
    match(tmp_path / "any.db", tmp_path / "pairs")
    assert thread_counts == [1]


@pytest.mark.slow
def test_matches_are_the_same_in_many_runs(features, scene, tmp_path):
    results = []
    for run in range(40):
        (tmp_path / str(run)).mkdir()
        results.append(_match_and_read(features, scene, tmp_path / str(run)))
    assert all(result == results[0] for result in results)


def test_a_failing_process_is_reported(features, scene, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(matches, "_MIN_PAIRS_PER_PROCESS", 4)
    monkeypatch.setattr(matches, "cpu_count", lambda: 2)
    monkeypatch.setattr(matches, "_write_list", lambda file, pairs: file)
    with check_error(ReconstructionError):
        _match_and_read(features, scene, tmp_path)
    assert "Check failed" in capfd.readouterr().err  # COLMAP's message


def test_the_log_leaves_no_files(tmp_path):
    """COLMAP's logger chooses its folder when it first writes, so a fresh process logs an error."""
    code = "from reconstructors.sfm.log import log_without_files; log_without_files(); import pycolmap"
    code += "; pycolmap.logging.error('lost')"
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "TMPDIR": str(tmp_path)}, capture_output=True, check=True
    )
    assert b"lost" in done.stderr
    assert not list(tmp_path.iterdir())
