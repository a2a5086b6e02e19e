"""The same photographs give the same bits: on one CPU or all, with few threads or many, beside busy processes."""

import pytest
import textured_corner as corner
from optional import import_or_skip
from repeats import CONDITIONS, repeat

import_or_skip("pycolmap")


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corner")
    return corner.write_scene(folder, corner.cameras(5, corner.standard_intrinsics(320, 240)))


@pytest.mark.long
@pytest.mark.parametrize("mapping", ["incremental", "global"])
def test_sparse_points_are_the_same_under_all_conditions(photographs, tmp_path, mapping):
    runs = [
        repeat("sfm", photographs, tmp_path / str(k), conditions, mapping=mapping)
        for k, conditions in enumerate(CONDITIONS)
    ]
    assert runs[0].points > 100
    assert len(set(runs)) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("mvs", {}),
        ("mvs", {"memory": "0.01"}),
        ("splat", {}),
        ("splat", {"memory": "0.003"}),
        ("field", {}),
    ],
    ids=["mvs", "mvs in blocks", "splat", "splat in blocks", "field"],
)
def test_dense_points_are_the_same_under_all_conditions(photographs, tmp_path, method, settings):
    if method != "mvs":
        import_or_skip("torch")
    runs = [
        repeat(method, photographs, tmp_path / str(k), conditions, **settings)
        for k, conditions in enumerate(CONDITIONS)
    ]
    assert runs[0].points > 100
    assert len(set(runs)) == 1
