"""Folders of rendered views: round trip, and refused folders."""

import json

import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error

from pcbench.errors import InputError
from pcbench.scenes.splits import split_every
from pcbench.scenes.views import ViewImages, find_views, read_views, write_views

import_or_skip("PIL")

NAMES = ("ring/0.jpg", "ring/1.png", "2.jpg", "3.jpg")


def view_images(name):
    rng = np.random.default_rng(NAMES.index(name))
    shape = (6 + NAMES.index(name), 9, 3)
    mask = None if name == "2.jpg" else rng.random(shape[:2]) < 0.5
    return ViewImages(name, rng.uniform(-0.2, 1.2, shape), rng.integers(0, 256, shape, dtype=np.uint8), mask)


@pytest.fixture
def folder(tmp_path):
    write_views(tmp_path / "rendered", "city", "splat", split_every(NAMES, 3), view_images)
    return tmp_path / "rendered"


def test_views_round_trip(folder):
    result = read_views(folder)
    assert (result.scene, result.method, result.split) == ("city", "splat", "one image in 3")
    assert [(view.name, view.block) for view in result.views] == [
        ("ring/1.png", None),
        ("2.jpg", None),
        ("ring/0.jpg", 0),
        ("3.jpg", 1),
    ]
    assert [view.is_test for view in result.views] == [False, False, True, True]
    for view in result.views:
        expected, images = view_images(view.name), view.read()
        np.testing.assert_array_equal(images.photograph, expected.photograph)
        np.testing.assert_array_equal(images.rendering, np.rint(255 * expected.rendering.clip(0, 1)))
        if expected.mask is None:
            assert images.mask is None
        else:
            np.testing.assert_array_equal(images.mask, expected.mask)


def test_views_are_found_in_a_workspace(folder, tmp_path):
    assert find_views(folder) == find_views(tmp_path) == folder
    workspace = tmp_path / "work"
    workspace.mkdir()
    assert find_views(workspace) is None
    with check_error():
        read_views(workspace)
    (workspace / "plugin").mkdir()
    folder.rename(workspace / "plugin" / "rendered")
    assert read_views(workspace).folder == workspace / "plugin" / "rendered"


def test_incomplete_folder_is_not_a_views_folder(tmp_path):
    def interrupted_images(name):
        if name == "ring/0.jpg":
            raise KeyboardInterrupt
        return view_images(name)

    with pytest.raises(KeyboardInterrupt):
        write_views(tmp_path, "city", "splat", split_every(NAMES, 3), interrupted_images)
    assert (tmp_path / "renderings" / "ring" / "1.png.png").is_file()
    assert find_views(tmp_path) is None
    write_views(tmp_path, "city", "splat", split_every(NAMES, 3), view_images)
    assert find_views(tmp_path) == tmp_path
    with pytest.raises(KeyboardInterrupt):
        write_views(tmp_path, "city", "splat", split_every(NAMES, 3), interrupted_images)
    assert find_views(tmp_path) is None


def test_invalid_views_are_refused_on_writing(tmp_path):
    split = split_every(NAMES, 3)

    def check_refusal(**change):
        with check_error():
            write_views(tmp_path, "city", "splat", split, lambda name: view_images(name)._replace(**change))

    check_refusal(rendering=np.zeros((2, 2, 3)))
    check_refusal(mask=np.ones((2, 2), dtype=bool))
    check_refusal(rendering=np.zeros((7, 9)), mask=None)
    check_refusal(rendering=np.full((7, 9, 3), np.nan), mask=None)
    with check_error():
        split_with_outside_name = split_every(("b", "../../../a", "c"), 2)
        write_views(
            tmp_path / "far" / "off" / "rendered",
            "city",
            "splat",
            split_with_outside_name,
            lambda name: view_images("2.jpg"),
        )
    assert not list(tmp_path.rglob("a*"))


def test_damaged_folders_give_a_one_line_error(folder):
    document = json.loads((folder / "views.json").read_text())

    def check_refusal(**change):
        (folder / "views.json").write_text(json.dumps({**document, **change}))
        with check_error() as caught:
            for view in read_views(folder).views:
                view.read()
        assert str(folder) in str(caught.value)

    view = document["views"][0]
    check_refusal(schema="pcbench.views/9")
    check_refusal(views=[])
    check_refusal(views=[{"name": "a"}])
    check_refusal(views=[{**view, "block": "one"}])
    check_refusal(views=[{**view, "rendering": "../../elsewhere.png"}])
    check_refusal(views=[{**view, "rendering": "renderings/none.png"}])
    check_refusal(views=[{**view, "rendering": document["views"][1]["rendering"]}])
    (folder / "views.json").write_text("{")
    with pytest.raises(InputError, match=r"views\.json: "):  # the rest of the message comes from Python's parser
        read_views(folder)
