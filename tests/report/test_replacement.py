"""Replacing a report: only its own files are removed, and a killed run leaves the old report or the new one."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error

from pcbench import Cloud, compare
from pcbench.report import report_folder
from pcbench.report.manifest import complete_replacement, is_report
from pcbench.report.plot import draw
from pcbench.report.read import read_report

OLD_FILES = {
    "comparison.json": "old",
    "a_T.txt": "old",
    "table.md": "old",
    "figures/a.png": "old",
    "figures/b.png": "old",
}
NEW_FILES = {
    "comparison.json": "new",
    "c_T.txt": "new",
    "table.md": "new",
    "figures/b.png": "new",
    "figures/c.svg": "new",
}
USER_FILES = {
    "notes.txt": "mine",
    "figures/for_my_paper.png": "mine",
    "figures/plan.svg": "mine",
    "more/deep/x.bin": "mine",
}


def write(folder, files):
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def read_files(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "manifest.json"
    }


def save(out, files):
    with report_folder(out) as folder:
        write(folder, files)


def save_until_killed(out, files, step):
    """Write a report in another process, killed before the `step`-th renaming; return False if there were fewer."""
    child = os.fork()
    if child == 0:
        steps_left = [step]

        def exit_at_step(change):
            def counted_change(*arguments, **options):
                steps_left[0] -= 1
                if steps_left[0] == 0:
                    os._exit(9)
                return change(*arguments, **options)

            return counted_change

        for name in ("rename", "replace", "unlink", "rmdir", "mkdir"):
            setattr(os, name, exit_at_step(getattr(os, name)))
        code = 1
        try:
            save(out, files)
            code = 0
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, 9)
    return code == 9


def complete_as_reader(out):
    complete_replacement(out)


def fail_as_next_run(out):
    """Run a comparison that fails before it writes anything."""
    with pytest.raises(ZeroDivisionError), report_folder(out):
        raise ZeroDivisionError


@pytest.mark.long
@pytest.mark.parametrize("next_step", [complete_as_reader, fail_as_next_run])
@pytest.mark.parametrize("existing", ["a report", "an empty folder", "nothing"])
def test_a_kill_at_any_step_leaves_a_whole_report(tmp_path, existing, next_step):
    is_new = []
    for step in range(1, 100):
        out = tmp_path / str(step) / "report"
        out.parent.mkdir()
        old_files, user_files = {}, {}
        if existing == "a report":
            old_files, user_files = OLD_FILES, USER_FILES
            save(out, old_files)
        elif existing == "an empty folder":
            out.mkdir()
        write(out, user_files)
        killed = save_until_killed(out, NEW_FILES, step)
        if out.exists() or next_step is fail_as_next_run:
            next_step(out)
        files = read_files(out) if out.exists() else {}
        assert files in ({**old_files, **user_files}, {**NEW_FILES, **user_files}), step
        is_new.append({**NEW_FILES, **user_files} == files)
        assert not [path for path in out.parent.glob(".*") if next_step is fail_as_next_run], step
        if not killed:
            break
        save(out, NEW_FILES)  # the next run succeeds
        assert read_files(out) == {**NEW_FILES, **user_files}
    assert is_new == sorted(is_new)
    assert not is_new[0]
    assert is_new[-1]
    # The first report appears by one rename. Later ones are killed both before and after their point of no return.
    assert existing == "nothing" or is_new.count(True) > 2


def test_only_files_that_the_report_wrote_are_replaced(tmp_path):
    save(tmp_path / "report", OLD_FILES)
    write(tmp_path / "report", USER_FILES)
    save(tmp_path / "report", NEW_FILES)
    assert read_files(tmp_path / "report") == {**NEW_FILES, **USER_FILES}
    assert sorted(json.loads((tmp_path / "report/manifest.json").read_text())["files"]) == sorted(NEW_FILES)


def test_a_file_of_the_user_in_the_way_is_refused(tmp_path):
    save(tmp_path / "report", OLD_FILES)
    write(tmp_path / "report", {"c_T.txt": "mine"})
    with check_error():
        save(tmp_path / "report", NEW_FILES)
    assert read_files(tmp_path / "report") == {**OLD_FILES, "c_T.txt": "mine"}
    (tmp_path / "report/c_T.txt").unlink()
    (tmp_path / "report/c_T.txt").mkdir()
    with check_error():
        save(tmp_path / "report", NEW_FILES)
    assert read_files(tmp_path / "report") == OLD_FILES


def test_a_link_leads_to_the_report(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "disk/report")
    for files in (OLD_FILES, NEW_FILES):
        with report_folder(tmp_path / "link") as folder:
            assert folder.parent == tmp_path / "disk"  # a folder is only renamed on one disk
            write(folder, files)
        assert (tmp_path / "link").is_symlink() and read_files(tmp_path / "disk/report") == files


def test_linked_figures_are_refused(tmp_path):
    save(tmp_path / "report", OLD_FILES)
    write(tmp_path / "pictures", {"a.png": "mine", "b.png": "mine"})
    for name in ("a.png", "b.png"):
        (tmp_path / "report/figures" / name).unlink()
    (tmp_path / "report/figures").rmdir()
    (tmp_path / "report/figures").symlink_to(tmp_path / "pictures")
    before = read_files(tmp_path)
    with check_error():
        save(tmp_path / "report", NEW_FILES)
    with check_error():
        draw(tmp_path / "report")
    assert read_files(tmp_path) == before


def test_links_of_map_folders_are_refused(tmp_path):
    write(tmp_path / "mine", {"tile_0000.laz": "mine"})
    save(tmp_path / "report", {**NEW_FILES, "maps/a_distance/tile_0000.laz": "tile"})
    (tmp_path / "report/maps/a_distance/tile_0000.laz").unlink()
    (tmp_path / "report/maps/a_distance").rmdir()
    (tmp_path / "report/maps/a_distance").symlink_to(tmp_path / "mine")
    with check_error():
        save(tmp_path / "report", NEW_FILES)
    assert (tmp_path / "mine/tile_0000.laz").read_text() == "mine"


@pytest.mark.parametrize(
    "name",
    [
        "maps/a/b/mine.txt",
        "maps/../../mine.txt",
        "../mine.txt",
        "/mine.txt",
        "figures/../../mine.txt",
        "more/mine.txt",
        "",
        ".",
        "..",
        "a\0b",
        5,
        None,
    ],
)
def test_a_forged_manifest_removes_nothing_elsewhere(tmp_path, name):
    write(tmp_path, {"mine.txt": "mine", "report/more/mine.txt": "mine"})
    manifest = {"schema": "pcbench.manifest/1", "files": [name, "stale.txt"]}
    write(tmp_path / "report", {"manifest.json": json.dumps(manifest), "stale.txt": ""})
    save(tmp_path / "report", NEW_FILES)
    assert read_files(tmp_path) == {"mine.txt": "mine", "report/more/mine.txt": "mine"} | {
        f"report/{key}": text for key, text in NEW_FILES.items()
    }


@pytest.mark.parametrize("text", ["{}", "[]", '{"schema": "other/1"}', '{"schema": 5}', "{", '{"candidates": []}'])
def test_a_foreign_document_does_not_make_a_report(tmp_path, text):
    for name in ("comparison.json", "deformation.json", "manifest.json"):
        folder = tmp_path / name
        write(folder, {name: text})
        assert not is_report(folder)
        with check_error():
            save(folder, NEW_FILES)
        assert (folder / name).read_text() == text


def test_pictures_drawn_later_belong_to_the_report(tmp_path):
    import_or_skip("matplotlib")
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 10, (400, 2)), np.zeros(400)])
    comparison = compare(Cloud(points), Cloud(points[::2] + rng.normal(0, 0.01, (200, 3))), register="none")
    out = tmp_path / "report"
    comparison.save(out, figures=False)
    write(out / "figures", {"mine.svg": "mine"})
    (figure,) = draw(out, ("distribution.svg",))
    comparison.save(out, figures=False)
    assert not figure.exists()
    assert [path.name for path in (out / "figures").iterdir()] == ["mine.svg"]
    assert read_report(out).candidates[0].name == "candidate_1"
    assert Path(out / "manifest.json").is_file()
