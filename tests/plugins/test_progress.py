"""Progress of a reconstruction, from its log to the progress callback."""

from pcbench.plugins import progress as module
from pcbench.plugins.progress import follow_log, progress, with_time_left
from pcbench.plugins.run import ReconstructionJob, run

PLUGIN = """
import numpy as np
from dataclasses import dataclass
from pathlib import Path
from pcbench import Cloud
from pcbench.plugins import Reconstruction
from pcbench.plugins.progress import with_time_left

@dataclass(frozen=True)
class Slow:
    def reconstruct(self, scene, workspace):
        print("something else")
        for _ in with_time_left("abc", "working"):
            pass
        return Reconstruction(Cloud(np.eye(3)), "arbitrary")
"""


def test_time_left_ignores_instant_items(capsys, monkeypatch):
    """The first two results exist from an earlier run; each of the other four takes 10 s."""
    clock = iter([0, 0.01, 0.02, 0.03, 1, 11, 11, 21, 21, 31, 31, 41])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    assert list(with_time_left("abcdef", "matching")) == list("abcdef")
    assert capsys.readouterr().err.splitlines() == [
        "progress: matching: 1 of 6 images",
        "progress: matching: 2 of 6 images",
        "progress: matching: 3 of 6 images, 30 s left",
        "progress: matching: 4 of 6 images, 20 s left",
        "progress: matching: 5 of 6 images, 10 s left",
        "progress: matching: 6 of 6 images",
    ]


def test_log_is_followed_to_its_end(tmp_path):
    log, reports = tmp_path / "log.txt", []
    with log.open("w") as file, follow_log(log, reports.append):
        print("noise", file=file)
        print("progress: 1 of 2", file=file)
        print("progress: 2 of 2", file=file, flush=True)
        file.write("progress: incomplete line")
        file.flush()
    assert reports == ["1 of 2", "2 of 2"]
    with follow_log(tmp_path / "nothing.txt", None):
        pass


def test_progress_lines_have_a_prefix(capsys):
    progress("meshing")
    assert capsys.readouterr().err == "progress: meshing\n"


def test_run_reports_progress(tmp_path):
    (tmp_path / "slow.py").write_text(PLUGIN)
    (tmp_path / "images").mkdir()
    from PIL import Image

    Image.new("RGB", (8, 8)).save(tmp_path / "images/a.png")
    reports = []
    job = ReconstructionJob(f"{tmp_path / 'slow.py'}:Slow", tmp_path)
    result = run(job, tmp_path / "work", on_progress=reports.append)
    assert result.status == "ok", result.message
    assert reports == [f"working: {k} of 3 images" for k in (1, 2, 3)]
