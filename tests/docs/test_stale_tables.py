"""Measurements whose code has changed since are listed; pages name the code of each measurement."""

import subprocess
import sys

import pytest
from repository import ROOT
from wording import check_text

SCRIPT = ROOT / "docs" / "stale_tables.py"
PAGE = "docs/measured/page.md"


@pytest.fixture
def stale_tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import stale_tables

    return stale_tables


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A new repository, and functions that commit files below `code/` and write the page."""
    for name in ("AUTHOR", "COMMITTER"):  # the names of the commits are the same in each run
        monkeypatch.setenv(f"GIT_{name}_DATE", "2026-01-01T00:00:00Z")
        monkeypatch.setenv(f"GIT_{name}_NAME", "a")
        monkeypatch.setenv(f"GIT_{name}_EMAIL", "a@b.example")

    class Repository:
        def commit(self, **files):
            for name, text in files.items():
                path = tmp_path / "code" / name.replace("_", ".")
                path.parent.mkdir(exist_ok=True)
                path.write_text(text)
            self.git("add", ".")
            self.git("commit", "--quiet", "--no-gpg-sign", "-m", "change")
            return self.git("rev-parse", "--short=8", "HEAD").strip()

        def git(self, *words):
            return subprocess.run(["git", "-C", tmp_path, *words], check=True, capture_output=True, text=True).stdout

        def write_page(self, text):
            path = tmp_path / PAGE
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    (tmp_path / "README.md").write_text("no measurement\n")
    (repository := Repository()).git("init", "--quiet")
    return repository


PYTHON = '"""A module."""\n\ndef f(x):\n    """Return a sum."""\n    return x + 1  # one more\n'
KERNEL = 'const char* url = "http://a"; // one\nint f(int x) { return x; } /* two\nlines */\n'


@pytest.mark.parametrize(
    "name, before, after, is_stale",
    [
        ("a_py", PYTHON, PYTHON.replace("Return a sum", "Return the sum").replace("one more", "plus one"), False),
        ("a_py", PYTHON, PYTHON.replace("x + 1", "(x\n        + 1)"), False),
        ("a_py", PYTHON, PYTHON.replace("+ 1", "+ 2"), True),
        ("a_h", KERNEL, KERNEL.replace("// one", "// 1").replace("two\nlines", "a line"), False),
        ("a_h", KERNEL, KERNEL.replace("http://a", "http://b"), True),
        ("a_h", KERNEL, KERNEL.replace("return x", "return -x"), True),
    ],
)
def test_only_changes_of_code_make_a_table_stale(repository, stale_tables, tmp_path, name, before, after, is_stale):
    first = repository.commit(**{name: before})
    repository.commit(**{name: after})
    repository.write_page(f"<!-- measures: code -->\n\n(commit {first}, 2 cores)\n")
    (measurement,) = stale_tables.all_measurements(tmp_path)
    assert measurement == (f"{PAGE}:3", first, ("code",), None)
    assert bool(stale_tables.status(measurement, tmp_path)) is is_stale


def test_each_finding_has_a_line(repository, stale_tables, tmp_path, capsys):
    first = repository.commit(a_py="a = 1\n", b_py="b = 1\n", c_py="c = 1\n")
    repository.commit(b_py="b = 2\n")
    (tmp_path / "code" / "c.py").unlink()
    last = repository.commit()
    repository.write_page(
        "| a table | of no code |\n|---|---|\n\n"
        f"<!-- measures: code -->\n\n| table | commit {first} |\n|---|---|\n\n"
        f"and at commit\n{last}, and 1234567 points\n"
        f"<!-- measures: code/a.py -->\n\ncommit {first}\n\ncommit 0123abcd of another history\n"
        "<!-- measures: code/b.py -->\n\nno commit\n"
    )
    assert stale_tables.main(tmp_path) == 0
    printed = capsys.readouterr().out.replace(first, "FIRST").replace(last[:7], "LAST")
    check_text(printed)


def test_shallow_clone_is_named(repository, stale_tables, tmp_path, capsys):
    first = repository.commit(a_py="a = 1\n")
    repository.write_page(f"<!-- measures: code -->\n\ncommit {first}\n")
    repository.commit(a_py="a = 2\n")
    subprocess.run(["git", "clone", "--quiet", "--depth=1", f"file://{tmp_path}", tmp_path / "shallow"], check=True)
    assert stale_tables.main(tmp_path / "shallow") == 0
    check_text(capsys.readouterr().out.replace(first, "FIRST"))


def test_without_a_repository_nothing_fails(stale_tables, tmp_path, capsys):
    assert stale_tables.main(tmp_path) == 0
    check_text(capsys.readouterr().out.replace(str(tmp_path), "FOLDER"))


def test_each_measurement_of_the_pages_names_code_that_exists(stale_tables):
    for measurement in stale_tables.all_measurements(ROOT):
        assert measurement.code, f"{measurement.place}: no comment `measures:` above, see docs/stale_tables.py"
        for path in measurement.code:
            assert (ROOT / path).exists(), f"{measurement.place}: no {path}"


@pytest.mark.long
def test_command_never_fails():
    process = subprocess.run([sys.executable, SCRIPT], capture_output=True, text=True)
    assert process.returncode == 0 and process.stdout, process.stderr
