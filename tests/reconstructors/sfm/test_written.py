"""Truncated files: those that COLMAP could not write completely are refused, others are recomputed."""

import os
import subprocess
import sys

import numpy as np
import pytest
import textured_corner as corner
from optional import import_or_skip
from wording import check_error

from pcbench.errors import ReconstructionError
from pcbench.scenes import read_scene
from reconstructors.sfm.model import check_written
from reconstructors.sfm.sfm import ColmapSfm

import_or_skip("pycolmap")

QUICK_SFM = ColmapSfm(upsample=False, features=1000)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corner")
    return corner.write_scene(folder, corner.cameras(5, corner.standard_intrinsics()))


@pytest.fixture(scope="module")
def workspace(photographs, tmp_path_factory):
    """Workspace after a reconstruction."""
    folder = tmp_path_factory.mktemp("work")
    QUICK_SFM.reconstruct(read_scene(photographs), folder)
    return folder


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_a_truncated_model_is_refused(workspace, tmp_path, name):
    model = tmp_path / "model"
    model.mkdir()
    for file in (workspace / "model").iterdir():
        (model / file.name).write_bytes(file.read_bytes())
    check_written(model)
    size = (model / name).stat().st_size
    for length in (size // 2, 8, 0):
        os.truncate(model / name, length)
        with check_error(ReconstructionError):
            check_written(model)
    (model / name).unlink()
    with check_error(ReconstructionError):
        check_written(model)


@pytest.mark.parametrize("file_name", ["features/database.db", "verified/database.db", "triangulation/0/images.bin"])
def test_a_truncated_stage_is_recomputed(photographs, workspace, file_name):
    scene = read_scene(photographs)
    first = QUICK_SFM.reconstruct(scene, workspace)
    size = (workspace / file_name).stat().st_size
    os.truncate(workspace / file_name, size // 2)
    second = QUICK_SFM.reconstruct(scene, workspace)
    np.testing.assert_array_equal(second.cloud.points, first.cloud.points)
    assert (workspace / file_name).stat().st_size == size


@pytest.mark.long
def test_a_file_size_limit_is_an_error_and_leaves_no_stage(photographs, tmp_path):
    """The limit is set before COLMAP writes the model, whose file of images exceeds it."""
    code = f"""
import resource
from pathlib import Path
from pcbench.errors import ReconstructionError
from pcbench.scenes import read_scene
from reconstructors.sfm import mapping
from reconstructors.sfm.sfm import ColmapSfm
posed_model = mapping.posed_model
def posed_model_with_limit(*arguments):  # sets the limit from here on; it is larger than a database at opening
    model = posed_model(*arguments)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, resource.RLIM_INFINITY))
    return model
scene, work = read_scene({str(photographs)!r}), Path({str(tmp_path)!r})
mapping.posed_model = posed_model_with_limit
try:
    ColmapSfm(upsample=False, features=1000).reconstruct(scene, work)
except ReconstructionError:
    print("refused", (work / "triangulation/stage.json").exists())
mapping.posed_model = posed_model
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
ColmapSfm(upsample=False, features=1000).reconstruct(scene, work)
"""
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (process.returncode, process.stdout) == (0, "refused False\n"), process.stderr
    check_written(tmp_path / "triangulation/0")
