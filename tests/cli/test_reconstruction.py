"""`pcbench plugins` and `pcbench reconstruct`."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import is_one_line
from optional import import_or_skip
from wording import check_text

from pcbench import Cloud, read_cloud


@pytest.mark.long
def test_reconstruct_and_plugins(tmp_path, monkeypatch, run):
    from pcbench.geometry.cameras import Camera, Intrinsics, look_at
    from pcbench.io.colmap_model import write_colmap_model

    image = import_or_skip("PIL.Image")
    monkeypatch.chdir(tmp_path)
    Path("photos").mkdir()
    image.new("RGB", (40, 30)).save("photos/0.png")
    camera = Camera("0.png", Intrinsics(40, 30, 35, 35, 20, 15), look_at([0, 0, 5], [1, 1, 0]))
    write_colmap_model(Path("photos/sparse"), [camera], Cloud(np.arange(12.0).reshape(4, 3)))
    Path("mine.py").write_text(
        "from dataclasses import dataclass\n"
        "from pcbench.plugins import Reconstruction\n"
        "@dataclass(frozen=True)\n"
        "class Mine:\n"
        '    """Returns what it got."""\n'
        "    points: int = 4\n"
        "    @classmethod\n"
        "    def missing(cls): return None\n"
        "    def reconstruct(self, scene, workspace):\n"
        "        notes = ['three', 'warning: four'] if self.points == 3 else []\n"
        "        points = scene.points.select(slice(self.points))\n"
        "        return Reconstruction(points, 'georeferenced', scene.cameras, notes)\n"
    )
    code, out, err = run("plugins", "mine.py:Mine")
    assert (code, err) == (0, "")
    assert "sfm (pcbench " in run("plugins")[1]
    assert "min_views: " not in run("plugins")[1]
    assert "min_views: " in run("plugins", "sfm")[1]
    check_text(out)
    assert "points=int" in out
    arguments = ("reconstruct", "mine.py:Mine", "photos", "-o", "cloud.ply")
    code, out, err = run(*arguments, "--set", "points=3", "--write-cameras", "cameras.json")
    assert (code, err) == (0, "warning: four\n")
    check_text("\n".join(out.splitlines()[:2]))  # times and memory follow
    assert "note: three\n" in out
    assert "four" not in out
    assert "3 points, georeferenced, 1 cameras" in out
    assert len(read_cloud("cloud.ply")) == 3
    assert json.loads(Path("cameras.json").read_text())["frames"][0]["file_path"] == "photos/0.png"
    Path("cloud.ply").unlink()
    for options in (("--set", "points=x"), ("--set", "points"), ("--cameras", "none"), ("--set", "other=1")):
        code, out, err = run(*arguments, *options)
        assert (code, out) == (2, "")
        assert is_one_line(err)
    # Unwritable outputs are reported before anything is computed.
    for options in (
        ("-o", "cloud.pts"),
        ("-o", "no/cloud.ply"),
        ("--write-cameras", "no/c.json"),
        ("--write-cameras", "mine.py"),
    ):
        code, out, err = run(*arguments, "--workspace", "untouched", *options)
        assert (code, out) == (2, "")
        assert is_one_line(err)
    assert not Path("untouched").exists()
    assert not Path("cloud.ply").exists()
    Path("mine.py").write_text(Path("mine.py").read_text().replace("return None", "return 'no such chip'"))
    assert "no such chip" in check_text(run("plugins", "mine.py:Mine")[1])
    assert "no such chip" in check_text(run(*arguments)[2])
    code, out, err = run("plugins", "mine.py:Yours")
    assert code == 2
    assert is_one_line(err)
