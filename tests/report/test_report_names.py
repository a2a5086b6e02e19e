"""Names of candidates follow from their files."""

from pathlib import Path

import pytest

from pcbench.report.names import check_name, names_of


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["x.ply", "y.ply"], ["x", "y"]),
        (["a/x.ply", "b/x.ply", "c/y.ply"], ["a_x", "b_x", "y"]),
        (["a/out/x.ply", "b/out/x.ply"], ["a_x", "b_x"]),
        (["a/out/x.ply", "b/x.ply"], ["out_x", "b_x"]),
        (["a/x.ply", "a/x.las"], ["x", "x_2"]),
        (["a/x.ply", "a/x.ply", "b/x.ply"], ["x", "x_2", "x_3"]),
        (["a/x.ply", "b/x.ply", "a_x.ply"], ["a_x", "b_x", "a_x_2"]),
        (["a/../c/x.ply", "b/x.ply"], ["c_x", "b_x"]),
        (["a\n\\/x.ply", "b/x.ply"], ["a___x", "b_x"]),
        (["\u202eylp.x.ply"], ["_ylp.x"]),  # reverses the text that follows
        (["/x.ply", "/b/x.ply"], ["x", "x_2"]),
        (["reference.ply"], ["reference_2"]),
        ([f"{'a' * 200}/{'x' * 100}.ply", f"{'b' * 200}/{'x' * 100}.ply"], ["x" * 100, "x" * 100 + "_2"]),
    ],
)
def test_files_of_one_name_are_named_after_their_folders(paths, names):
    assert names_of([Path("/data") / path for path in paths]) == names
    assert [check_name(name) for name in names] == names


def test_the_working_directory_names_a_file_too(tmp_path, monkeypatch):
    (tmp_path / "scans").mkdir()
    monkeypatch.chdir(tmp_path / "scans")
    assert names_of([Path("x.ply"), Path("b/x.ply")]) == ["scans_x", "b_x"]
