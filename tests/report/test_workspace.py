"""Workspaces of tiled comparisons: equal ones at the same time, and removals that are interrupted."""

import shutil
from contextlib import ExitStack

import pytest

from pcbench.comparison import workspace
from pcbench.comparison.workspace import default_workspaces, first_free_workspace
from pcbench.scratch import OutputInUse

KEY = "0123456789abcdef" * 4


@pytest.fixture(autouse=True)
def _private_temporary_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(workspace.tempfile, "gettempdir", lambda: str(tmp_path))


def opened(stack, folders, notices=None):
    notices = [] if notices is None else notices
    return stack.enter_context(first_free_workspace(folders, KEY, notices.append))


def test_equal_comparisons_have_different_workspaces():
    with ExitStack() as stack:
        first, second = (opened(stack, default_workspaces(None, KEY)) for _ in range(2))
        assert first.name == "pcbench-tiles-0123456789abcdef" and second.name == f"{first.name}-2"
    assert not first.exists() and not second.exists()


def test_finished_parts_of_a_second_run_are_continued(tmp_path):
    with ExitStack() as stack:
        opened(stack, default_workspaces(None, KEY))
        with (
            pytest.raises(KeyboardInterrupt),
            first_free_workspace(default_workspaces(None, KEY), KEY, print) as second,
        ):
            (second / "part").write_text("finished")
            raise KeyboardInterrupt
    with ExitStack() as stack:
        notices = []
        assert opened(stack, default_workspaces(None, KEY), notices) == second
        assert (second / "part").exists() and notices[0].startswith("continuing")


def test_a_named_workspace_has_one_run(tmp_path):
    for folders in ([tmp_path / "work"], default_workspaces(tmp_path / "report", KEY)):
        with ExitStack() as stack, pytest.raises(OutputInUse):
            opened(stack, folders)
            opened(stack, folders)


def test_what_an_interrupted_removal_leaves_is_still_a_workspace(tmp_path, monkeypatch):
    def too_many_files(path, **_):
        raise OSError(24, "Too many open files")

    folders = [tmp_path / "work"]
    with monkeypatch.context() as patch, ExitStack() as stack:
        (opened(stack, folders) / "results").mkdir()
        patch.setattr(shutil, "rmtree", too_many_files)
        stack.close()
    assert (tmp_path / "work" / "workspace.json").exists()
    with ExitStack() as stack:
        opened(stack, folders)
    assert not (tmp_path / "work").exists()
