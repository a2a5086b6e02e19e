"""`pcbench scene`. What `synth` makes is tested in tests/scenes."""

from pathlib import Path

import pytest
from command_line import one_line


def test_scene_says_what_is_there_and_converts_cameras(tmp_path, monkeypatch, run):
    from pcbench.geometry.cameras import Camera, Intrinsics, look_at
    from pcbench.io.colmap_model import write_colmap_model

    image = pytest.importorskip("PIL.Image")
    monkeypatch.chdir(tmp_path)
    Path("photos/images").mkdir(parents=True)
    cameras = []
    for number in range(3):
        image.new("RGB", (40, 30)).save(f"photos/images/{number}.png")
        cameras.append(Camera(f"{number}.png", Intrinsics(40, 30, 35, 35, 20, 15), look_at([number, 0, 5], [1, 1, 0])))
    write_colmap_model(Path("photos/sparse"), cameras)
    code, out, err = run("scene", "photos", "--write-cameras", "photos/transforms.json", "--figure", "cameras.png")
    assert (code, err) == (0, "")
    assert "3 images of 40 x 30" in out
    assert "cameras 3, GPS 0, masks 0" in out
    assert Path("cameras.png").stat().st_size
    code, out, err = run("scene", "photos", "--cameras", "photos/transforms.json", "--image-scale", "0.5")
    assert (code, err) == (0, "")
    assert "3 images of 20 x 15" in out
    before = Path("photos/images/1.png").read_bytes()
    code, out, err = run("scene", "photos", "--figure", "photos/images/1.png")
    assert code == 2
    assert one_line(err)
    assert "would replace an input" in err
    assert Path("photos/images/1.png").read_bytes() == before
    Path("photos/images/1.png").write_bytes(b"")
    for arguments in (("photos",), ("nowhere",), ("photos", "--image-scale", "2")):
        code, out, err = run("scene", *arguments, "--figure", "other.png")
        assert (code, out) == (2, "")
        assert one_line(err)
    assert not Path("other.png").exists()
