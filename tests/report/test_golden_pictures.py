"""Pictures of a report that are drawn without OpenGL, compared with golden ones."""

import pytest
from children_here import drawing_here
from coloured_cities import coloured_city
from optional import import_or_skip
from pictures import check_picture, is_similar, read, reduced

import pcbench
from pcbench import write_cloud
from pcbench.report import Figures
from pcbench.report.plot import draw

NAMES = (
    *("reference", "distribution", "bent_colors", "bent_plane_distance", "bent_completeness", "bent_section"),
    *("bent_deformation", "bent_displacement"),
)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report of a bent city."""
    import_or_skip("matplotlib")
    folder = tmp_path_factory.mktemp("golden")
    write_cloud(folder / "reference.ply", coloured_city(40_000, 1))
    write_cloud(folder / "bent.ply", coloured_city(15_000, 2, bowl=1e-3))
    pcbench.compare(folder / "reference.ply", folder / "bent.ply").save(folder / "report", figures=False)
    return folder / "report"


@pytest.fixture(scope="module")
def pictures(report):
    with drawing_here():
        return {path.stem: read(path) for path in draw(report, NAMES)}


@pytest.mark.parametrize("name", NAMES)
def test_pictures_look_as_before(pictures, name, renew_pictures):
    check_picture(f"report_{name}", pictures[name], renew=renew_pictures)


def test_another_colour_range_looks_different(pictures, report):
    """A range twice as large is another picture, so that a wrong scale of colours is found."""
    with drawing_here():
        (path,) = draw(report, ("bent_plane_distance",), figures=Figures(range=1.1))
    assert not is_similar(reduced(pictures["bent_plane_distance"]), reduced(read(path)))
