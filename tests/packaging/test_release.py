"""A release sets the version and dates the changelog of a clean clone, and nothing else."""

import datetime
import subprocess
import tomllib

import pytest
from repository import ROOT

DATE = datetime.date(2026, 12, 1)
CHANGELOG = "# Changelog\n\n## Unreleased\n\n- News.\n\n## 0.1.0 (2026-01-01)\n\n- Old.\n"


@pytest.fixture
def release(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "packaging")
    import release

    return release


@pytest.fixture
def clone(tmp_path, release, monkeypatch):
    """A repository with this project's files that state the version."""
    for name in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{name}_NAME", "A")
        monkeypatch.setenv(f"GIT_{name}_EMAIL", "a@example.org")
    for name in release.VERSION_LINES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text((ROOT / name).read_text())
    (tmp_path / "CHANGELOG.md").write_text(CHANGELOG)
    for arguments in (["init", "--quiet"], ["add", "."], ["commit", "--quiet", "--message", "Start"]):
        subprocess.run(["git", "-C", tmp_path, *arguments], check=True)
    return tmp_path


def test_release_states_version_and_date(release, clone):
    release.prepare(clone, "99.0.0", DATE)
    assert tomllib.loads((clone / "pyproject.toml").read_text())["project"]["version"] == "99.0.0"
    assert '\n  version: "99.0.0"\n' in (clone / "packaging/conda/recipe.yaml").read_text()
    changed_text = CHANGELOG.replace("Unreleased\n", "Unreleased\n\n## 99.0.0 (2026-12-01)\n")
    assert (clone / "CHANGELOG.md").read_text() == changed_text
    release.commit(clone, "99.0.0")
    assert release.git(clone, "describe", "--tags").strip() == "v99.0.0"
    assert not release.git(clone, "status", "--porcelain")


def test_release_is_refused(release, clone):
    """A wrong or old version, local changes, and a changelog without news leave all files as they are."""
    for version, reason in (("0.2", "such as 0.2.0"), ("0.0.9", "already")):
        with pytest.raises(ValueError, match=reason):
            release.prepare(clone, version, DATE)
    (clone / "CHANGELOG.md").write_text(CHANGELOG.replace("- News.\n", ""))
    with pytest.raises(ValueError, match="has changes"):
        release.prepare(clone, "99.0.0", DATE)
    release.git(clone, "commit", "--all", "--quiet", "--message", "No news")
    with pytest.raises(ValueError, match="nothing under Unreleased"):
        release.prepare(clone, "99.0.0", DATE)
    assert not release.git(clone, "status", "--porcelain")
