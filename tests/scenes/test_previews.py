"""Previews of a training: what is written is read, and damage is one line."""

import json

import numpy as np
import pytest
from training_previews import preview_of, write_preview_folder
from wording import check_error, check_text

from pcbench import read_cloud
from pcbench.scenes.decode import decode_image
from pcbench.scenes.previews import DOCUMENT, PHOTOGRAPH, POINTS, find_preview, read_preview


def test_a_preview_is_read_as_written(tmp_path):
    folder = write_preview_folder(tmp_path / "work", (10, 20))
    assert find_preview(tmp_path / "work") == find_preview(folder) == folder
    assert find_preview(tmp_path) is None
    assert read_preview(folder) == preview_of((10, 20))
    assert len(read_cloud(folder / POINTS)) == 20
    assert (decode_image(folder / PHOTOGRAPH, (40, 30)) == 200).all()
    check_text(read_preview(folder).sentence)
    check_text(preview_of((10,), held_out=False).sentence)


TEXTS = dict.fromkeys(("done", "step", "loss", "psnr", "held_out_psnr", "gaussians"), "x")


@pytest.mark.parametrize(
    "change",
    [
        {"schema": "x"},
        {"history": []},
        {"history": [{"step": 1}]},
        {"steps": None},
        {"history": [TEXTS]},
        {"sizes": [{"gaussians": "x"}]},
    ],
)
def test_a_damaged_preview_is_one_line(tmp_path, change):
    folder = write_preview_folder(tmp_path, (10,))
    document = json.loads((folder / DOCUMENT).read_text()) | change
    if change.get("steps", 0) is None:
        del document["steps"]
    (folder / DOCUMENT).write_text(json.dumps(document))
    with check_error():
        read_preview(folder)


def test_nothing_is_half_written(tmp_path, monkeypatch):
    """A later preview that fails leaves the state of the earlier one."""
    folder = write_preview_folder(tmp_path, (10,))
    with pytest.raises(AttributeError):
        write_preview_folder(tmp_path, (10, 20), rendering=None)
    assert read_preview(folder) == preview_of((10,))
    assert np.isfinite(read_cloud(folder / POINTS).points).all()
