"""Digests of input files: all bytes of all files count, and a file that changes while it is read is refused."""

import json
import os

import ept_bytes
import numpy as np
import pytest
from wording import check_error

from pcbench.errors import PcbenchError
from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud
from pcbench.io.contents import FileState, digest
from pcbench.io.source import Source


def change_silently(path):
    """Change a byte in the middle of a file, and restore its time."""
    before = path.stat()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.fixture
def inputs(tmp_path):
    """Each kind of input that has several files: its path, and its files."""
    folder = tmp_path / "tiles"
    folder.mkdir()
    tiles = [folder / f"{number}.ply" for number in range(3)]
    for number, tile in enumerate(tiles):
        write_cloud(tile, Cloud(np.eye(3) + number))
    (folder / "notes.txt").write_text("not a cloud")
    index = tmp_path / "tiles.vpc"
    assets = [{"href": f"tiles/{tile.name}"} for tile in tiles]
    index.write_text(json.dumps({"features": [{"assets": {"data": asset}} for asset in assets]}))
    ept_bytes.write(tmp_path / "ept")
    nodes = [path for path in (tmp_path / "ept").rglob("*") if path.is_file()]
    assert len(nodes) > 3
    model = tmp_path / "model.gltf"
    model.write_text(json.dumps({"buffers": [{"uri": "model%20data.bin"}, {"uri": "data:,"}, {"uri": "missing"}]}))
    (tmp_path / "model data.bin").write_bytes(bytes(100))
    return {
        folder: tiles,
        folder / "*.ply": tiles,
        index: [index, *tiles],
        tmp_path / "ept": nodes,
        tmp_path / "ept" / "ept.json": nodes,
        model: [model, tmp_path / "model data.bin"],
        tiles[0]: tiles[:1],
    }


def test_each_byte_of_each_file_counts(inputs):
    for path, files in inputs.items():
        source = Source.open(path)
        assert source.contents().keys() == set(files)
        digests = {source.digest()}
        assert digests == {source.digest(source.contents())}
        for file in files:
            if file.name == "tiles.vpc":  # a changed byte is another index
                file.write_text(file.read_text() + " ")
            elif file.name not in ("ept.json", "model.gltf"):
                change_silently(file)
            else:
                continue
            digests.add(source.digest())
        assert len(digests) > 1 + len(files) - 2, path


def test_one_file_has_the_digest_of_its_bytes(inputs):
    *several, single = inputs
    assert Source.open(single).digest() == digest(single) and len(digest(single)) == 64
    assert all(Source.open(path).digest().startswith("files:") for path in several)


def test_a_file_that_changes_while_it_is_read(inputs, monkeypatch):
    for path, files in inputs.items():
        source, shape = Source.open(path), object()
        monkeypatch.setattr(Source, "read", lambda source, on_warning, shape=shape: shape)
        assert source.read_with_digest(print) == (shape, source.digest())
        if path.suffix != ".vpc":
            last = next(file for file in files[::-1] if file.name != "ept.json")
            monkeypatch.setattr(Source, "read", lambda source, on_warning, last=last: change_silently(last))
            with check_error(PcbenchError):
                source.read_with_digest(print)


def test_a_known_state(tmp_path):
    file = tmp_path / "a.txt"
    file.write_text("content")
    state = FileState.of(file)
    state.check()
    os.utime(file, ns=(1, 1))
    state.check()  # the same content at another time
    change_silently(file)
    with pytest.raises(PcbenchError, match="changed"):
        state.check()
