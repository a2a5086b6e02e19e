"""Pipes and devices where a file is expected: one line, at once, for every option that names a file."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scene_folders
from command_line import is_one_line
from wording import check_error, check_text

from pcbench import Cloud, write_cloud
from pcbench.errors import InputError
from pcbench.io.colmap_model import write_colmap_model
from pcbench.regular_files import is_regular_file, open_regular, read_bytes, read_text

# Limits for the child, so that a command that hangs or fills the memory ends only it: seconds, bytes of address space.
_MAX_SECONDS, _MAX_MEMORY = 240, 6 << 30

# Runs each line of its input as a command and says after each how it ended.
_RUNNER = f"""
import contextlib, io, json, resource, sys
resource.setrlimit(resource.RLIMIT_AS, ({_MAX_MEMORY}, {_MAX_MEMORY}))
from pcbench import cli
for line in sys.stdin.read().splitlines():
    sys.argv = ["pcbench", *line.split()]
    code, errors = 0, io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code
    print(json.dumps([line, code, errors.getvalue()]), flush=True)
"""

COMMANDS = {
    "a cloud": "info FILE.ply",
    "a reference": "compare FILE.ply a.ply --no-figures",
    "a polygon": "crop a.ply out.ply --crop polygon:FILE",
    "a polygon of a comparison": "compare a.ply a.ply --no-figures --crop polygon:FILE",
    "a matrix": "register a.ply a.ply --register matrix:FILE",
    "a matrix of a comparison": "compare a.ply a.ply --no-figures --register matrix:FILE",
    "pairs of points": "register a.ply a.ply --register points:FILE",
    "settings": "compare --settings FILE",
    "core points": "compare a.ply a.ply --no-figures --m3c2 radius=1,cores=FILE.ply",
    "cameras": "scene photos --cameras FILE",
    "control points": "reconstruct sfm photos -o out.ply --set control=FILE",
    "a buffer of glTF": "info mesh.gltf",
    "a plugin": "reconstruct FILE.py:Mine photos -o out.ply",
}
_TRIANGLE = {
    "asset": {"version": "2.0"},
    "buffers": [{"uri": "FILE", "byteLength": 36}],
    "bufferViews": [{"buffer": 0, "byteLength": 36}],
    "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    "nodes": [{"mesh": 0}],
    "scenes": [{"nodes": [0]}],
    "scene": 0,
}
# Entries of a scene's folder that may be special files, and the file that each replaces.
SCENE_FILES = {
    "COLMAP's cameras": "sparse/0/cameras.txt",
    "COLMAP's images": "sparse/0/images.txt",
    "COLMAP's points": "sparse/0/points3D.txt",
    "transforms.json": "transforms.json",
    "an export of Earth Studio": "export.json",
    "a camera of Strecha's": "0.png.camera",
    "positions": "gps.txt",
    "an image": "images/0.png",
    "a mask": "masks/0.png",
}


def _make_pipe(path):
    os.mkfifo(path)


def _link_device(path):
    path.symlink_to("/dev/zero")


@pytest.fixture(scope="module", params=[_make_pipe, _link_device], ids=["pipe", "device"])
def outcomes(request, tmp_path_factory):
    """Return exit code and standard error of each command."""
    folder = tmp_path_factory.mktemp(request.param.__name__)
    for name in ("FILE", "FILE.ply", "FILE.py"):
        request.param(folder / name)
    (folder / "mesh.gltf").write_text(json.dumps(_TRIANGLE))
    write_cloud(folder / "a.ply", Cloud(np.random.default_rng(0).normal(size=(500, 3))))
    scene_folders.ten_images_folder(folder / "photos")
    commands = dict(COMMANDS)
    for number, (what, name) in enumerate(SCENE_FILES.items()):
        scene = scene_folders.ten_images_folder(folder / f"scene{number}")
        if "sparse" in name:
            write_colmap_model(scene / "sparse/0", scene_folders.orbit(scene_folders.NAMES))
            (scene / name).unlink()
        elif "images" in name:
            (scene / name).unlink()
        (scene / name).parent.mkdir(exist_ok=True)
        request.param(scene / name)
        commands[what] = f"scene scene{number}"
    child = [sys.executable, "-c", _RUNNER]
    with (folder / "errors").open("w") as errors:
        try:
            lines = subprocess.run(
                child,
                input="\n".join(commands.values()),
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                cwd=folder,
                timeout=_MAX_SECONDS,
            ).stdout
        except subprocess.TimeoutExpired as expired:
            lines = (expired.stdout or b"").decode()
    outcome_of_command = {line: (code, err) for line, code, err in map(json.loads, lines.splitlines())}
    timed_out = (None, "it did not end")
    return {what: outcome_of_command.get(command, timed_out) for what, command in commands.items()}


@pytest.mark.parametrize("what", [*COMMANDS, *SCENE_FILES])
def test_a_pipe_or_a_device_is_refused_in_one_line(outcomes, what):
    code, err = outcomes[what]
    if what == "an image":  # it is left out
        assert (code, err.startswith("warning: "), err.count("\n")) == (0, True, 1), err
    else:
        assert (code, is_one_line(err)) == (2, True), err
    check_text(err)


def test_links_to_regular_files_are_read(tmp_path):
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbftext")
    (tmp_path / "link").symlink_to(tmp_path / "a")
    assert read_text(tmp_path / "link") == "text"
    with open_regular(tmp_path / "link") as file:
        assert file.read() == b"\xef\xbb\xbftext"


def test_texts_are_bounded(tmp_path):
    """A sparse file, larger than its space on the disk, is refused without reading."""
    with (tmp_path / "a").open("wb") as file:
        file.truncate(1 << 40)
    with check_error():
        read_bytes(tmp_path / "a")
    (tmp_path / "b").write_bytes(bytes(11))
    assert read_bytes(tmp_path / "b", 11) == bytes(11)
    with pytest.raises(InputError):
        read_bytes(tmp_path / "b", 10)


def test_binary_files_are_refused_as_text(tmp_path):
    (tmp_path / "a").write_bytes(b"\xff\xfe\x00")
    with check_error():
        read_text(tmp_path / "a")
    with check_error():
        read_text(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_text(Path(tmp_path / "none"))


@pytest.mark.parametrize("text", ["x" * 300, "a\0b", "", "none"])
def test_invalid_file_names_are_not_files(text):
    assert not is_regular_file(text)
    assert is_regular_file(__file__)
