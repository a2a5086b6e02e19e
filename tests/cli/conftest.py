import shutil
from pathlib import Path

import numpy as np
import pytest
import shapes

from pcbench import Cloud, cli, write_cloud


def write_clouds():
    """Write ref.ply, a.ply and b.ply to the current folder."""
    rng = np.random.default_rng(0)
    reference = shapes.city(4000, noise=0.01, seed=1)[0]
    write_cloud("ref.ply", Cloud(reference, unit="m"))
    for name, count, noise in (("a", 1500, 0.02), ("b", 700, 0.05)):
        points = shapes.city(count, seed=count)[0]
        write_cloud(f"{name}.ply", Cloud(points + rng.normal(0, noise, points.shape) + [0.05, 0.02, 0]))


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """Return a folder with the clouds, `report` (of `compare ref.ply a.ply`) and `bend` (of `deform ref.ply a.ply`)."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_clouds()
        for command in ("compare ref.ply a.ply --out report", "deform ref.ply a.ply --out bend"):
            cli.app([*command.split(), "--no-figures", "-q"], standalone_mode=False)
    return folder


@pytest.fixture(autouse=True)
def _no_deformation(request):
    """Test no deformation, which takes half of a comparison, in tests that are not marked `with_deformation`."""
    if request.node.get_closest_marker("with_deformation") is None:
        request.getfixturevalue("without_deformation")


@pytest.fixture
def files(finished, tmp_path, monkeypatch):
    """Copy ref.ply, a.ply and b.ply to the current folder."""
    monkeypatch.chdir(tmp_path)
    for path in finished.glob("*.ply"):
        shutil.copy(path, path.name)
    return tmp_path


@pytest.fixture
def report(finished, files):
    """Copy the report of `compare ref.ply a.ply` to the current folder, beside the clouds."""
    return Path(shutil.copytree(finished / "report", "report"))


@pytest.fixture
def bend(finished, files):
    """Copy the results of `deform ref.ply a.ply` to the current folder, beside the clouds."""
    return Path(shutil.copytree(finished / "bend", "bend"))
