"""Stale tables and records of experiments without a commit are listed; each record of the pages has one."""

import subprocess
import sys

import pytest
from repository import ROOT
from wording import check_text

SCRIPT = ROOT / "docs" / "stale_tables.py"


@pytest.fixture
def stale_tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import stale_tables

    return stale_tables


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A new repository with a commit, a page of trials and a measured page; returns the commit."""
    for name in ("AUTHOR", "COMMITTER"):  # the name of the commit is the same in each run
        monkeypatch.setenv(f"GIT_{name}_DATE", "2026-01-01T00:00:00Z")
        monkeypatch.setenv(f"GIT_{name}_NAME", "a")
        monkeypatch.setenv(f"GIT_{name}_EMAIL", "a@b.example")

    def git(*words):
        return subprocess.run(["git", "-C", tmp_path, *words], check=True, capture_output=True, text=True).stdout

    git("init", "--quiet")
    git("commit", "--quiet", "--no-gpg-sign", "--allow-empty", "-m", "change")
    commit = git("rev-parse", "--short=8", "HEAD").strip()
    for folder in ("trials", "measured"):
        (tmp_path / "docs" / folder).mkdir(parents=True)
    (tmp_path / "docs/trials/page.md").write_text(
        f"# Trials\n\n## First\n\n(commits {commit} and\n0123abcd, 2 cores)\n\n"
        "## Second\n\nOn 2026-11-25, 1234567 points.\n\n## Third\n\nA defaced facade.\n"
    )
    (tmp_path / "docs/measured/page.md").write_text(
        f"It takes 3 s (commit {commit}).\n\n<!-- made by: python benchmarks/a.py -->\n```text\ncommit {commit}\n```\n"
    )
    return commit


def test_each_finding_has_a_line(repository, stale_tables, tmp_path, capsys):
    assert stale_tables.main(tmp_path) == 0
    check_text(capsys.readouterr().out.replace(repository, "FIRST"))


def test_shallow_clone_is_named(repository, stale_tables, tmp_path, capsys):
    for words in (["add", "."], ["commit", "--quiet", "--no-gpg-sign", "-m", "pages"]):
        subprocess.run(["git", "-C", tmp_path, *words], check=True)
    subprocess.run(["git", "clone", "--quiet", "--depth=1", f"file://{tmp_path}", tmp_path / "shallow"], check=True)
    assert stale_tables.main(tmp_path / "shallow") == 0
    check_text(capsys.readouterr().out.replace(repository, "FIRST"))


def test_without_a_repository_nothing_fails(stale_tables, tmp_path, capsys):
    assert stale_tables.main(tmp_path) == 0
    check_text(capsys.readouterr().out.replace(str(tmp_path), "FOLDER"))


def test_records_name_their_commits_and_other_pages_name_none(stale_tables):
    """Commits are not looked up here: a shallow clone lacks them."""
    for page in stale_tables.pages(ROOT):
        name, text = page.relative_to(ROOT).as_posix(), page.read_text()
        if not name.startswith(stale_tables.TRIALS):
            assert list(stale_tables._commits_beside_tables(name, text)) == []
            continue
        assert len(text.split()) <= 5000, f"{name}: split it"
        for number, entry in stale_tables._entries(text):
            assert stale_tables._COMMIT.search(entry) or stale_tables._DATE.search(entry), f"{name}:{number}: no commit"


@pytest.mark.long
def test_command_never_fails():
    process = subprocess.run([sys.executable, SCRIPT], capture_output=True, text=True)
    assert process.returncode == 0 and process.stdout, process.stderr
