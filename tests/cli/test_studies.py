"""`pcbench demo`; tests/studies tests `bench` and `experiment`."""

import pytest
from command_line import REPORT
from wording import check_text


@pytest.mark.long
def test_demo_at_a_small_size(tmp_path, run):
    code, out, _ = run("demo", "--points", 20_000, "--out", tmp_path / "demo", "--no-figures", "--no-bench")
    assert code == 0
    assert {p.name for p in (tmp_path / "demo/report").iterdir()} >= REPORT
    # The command that it prints works.
    arguments = (
        out.strip().splitlines()[-1].partition("repeat with: pcbench ")[2].replace("REPORT", str(tmp_path / "again"))
    )
    assert run(*arguments.split())[0] == 0


def test_the_demo_writes_into_no_folder_of_others(tmp_path, run):
    (tmp_path / "clouds").mkdir()
    user_file = tmp_path / "clouds" / "reference.ply"
    user_file.write_text("mine")
    code, _, err = run("demo", "--points", 20_000, "--out", tmp_path)
    assert code == 2
    check_text(err)
    assert user_file.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [tmp_path / "clouds"]


def test_a_demo_of_nothing_is_refused(tmp_path, run):
    code, _, err = run("demo", "--no-bench", "--no-clouds", "--out", tmp_path / "demo")
    assert code == 2
    check_text(err)
    assert not (tmp_path / "demo").exists()
