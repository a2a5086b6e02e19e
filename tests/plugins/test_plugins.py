"""Plugins: lookup, settings, the child process, and failures as results."""

import re
import subprocess
import sys
import textwrap
from contextlib import nullcontext
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from children_here import reconstructing_here
from optional import import_or_skip
from processes import has_ended
from repository import ROOT
from wording import check_error, check_text

from pcbench import Cloud, plugins, read_cloud
from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.io.colmap_model import write_colmap_model
from pcbench.io.image_header import read_image_header
from pcbench.plugins import Reconstruction, find_plugin
from pcbench.plugins import run as runs
from pcbench.plugins.run import ReconstructionJob, read_reconstruction, run
from pcbench.registration import SurveyResiduals

POINTS = np.random.default_rng(0).normal(size=(30, 3))

IMPORTS = """
import errno, os, sys, time, signal
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
import numpy as np
from pcbench import Cloud
from pcbench.errors import ReconstructionError
from pcbench.plugins import Reconstruction
from pcbench.plugins.stages import stage
"""


@pytest.fixture
def scene(tmp_path):
    """Three images with cameras and 30 sparse points."""
    image = import_or_skip("PIL.Image")
    folder = tmp_path / "photos"
    (folder / "images").mkdir(parents=True)
    cameras = []
    for number in range(3):
        image.new("RGB", (40, 30), (number, 0, 0)).save(folder / f"images/{number}.png")
        cameras.append(Camera(f"{number}.png", Intrinsics(40, 30, 35, 35, 20, 15), look_at([number, 0, 5], [1, 1, 0])))
    write_colmap_model(folder / "sparse", cameras, Cloud(POINTS))
    return folder


@pytest.fixture
def plugin(tmp_path):
    """Return a function that writes a reconstructor with a given method body and returns its spec."""

    def write_plugin(body, fields="pass"):
        method = textwrap.indent("def reconstruct(self, scene, workspace):\n" + textwrap.indent(body, "    "), "    ")
        text = f"{IMPORTS}\n@dataclass(frozen=True)\nclass Mine:\n{textwrap.indent(fields, '    ')}\n{method}\n"
        (tmp_path / "mine.py").write_text(text)
        return f"{tmp_path / 'mine.py'}:Mine"

    return write_plugin


VALID_BODY = 'return Reconstruction(scene.points, "georeferenced", scene.cameras, ["all well"])'


def test_documented_plugin_runs(scene, tmp_path):
    """Run the documented command in a folder outside of the repository."""
    page = (ROOT / "docs" / "reconstructors.md").read_text()
    code = re.search(
        r'```python title="projected.py"\n(.*?)```\n.*?\n\$ (pcbench reconstruct projected[^\n]*)\n', page, re.DOTALL
    )
    (tmp_path / "projected.py").write_text(code[1])
    scene.rename(tmp_path / "city")
    process = subprocess.run(
        [sys.executable, "-m", "pcbench.cli", *code[2].split()[1:]],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (process.returncode, process.stderr) == (0, "")
    assert "105 points, georeferenced, 3 cameras" in process.stdout
    ground = read_cloud(tmp_path / "projected.ply")
    assert len(ground.points) == 3 * 7 * 5  # images of 40 x 30 pixels
    np.testing.assert_allclose(ground.points[:, 2], 0, atol=1e-5)  # float32 at some ten metres


def test_run_returns_the_complete_reconstruction(scene, plugin, tmp_path):
    spec = plugin(
        "print('hello'); print(self.n, self.how, file=sys.stderr);" + VALID_BODY, "n: int = 2\nhow: str = 'x'"
    )
    result = run(
        ReconstructionJob(spec, scene, {"n": "5"}, image_scale=0.5, images=("0.png", "2.png")), tmp_path / "work"
    )
    assert (result.status, result.message) == ("ok", "")
    assert result.settings == {"n": "5", "how": "x"}
    assert result.log.read_text() == "hello\n5 x\n"
    reconstruction = result.require_reconstruction()
    np.testing.assert_array_equal(reconstruction.cloud.points, POINTS)
    assert (reconstruction.gauge, reconstruction.notes) == ("georeferenced", ("all well",))
    assert list(reconstruction.cameras) == ["0.png", "2.png"]
    assert reconstruction.cameras["2.png"].intrinsics.width == 20
    assert result.cpu_s > 0
    assert result.wall_s > 0
    assert 10e6 < result.peak_rss_bytes < 10e9  # an interpreter with numpy is some 40 MB


def test_blas_uses_one_thread_unless_the_user_sets_it(scene, plugin, tmp_path, monkeypatch):
    job = ReconstructionJob(plugin("print(os.environ['OPENBLAS_NUM_THREADS']);" + VALID_BODY), scene)
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert run(job, tmp_path / "work").log.read_text() == "1\n"
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    assert run(job, tmp_path / "work").log.read_text() == "3\n"


@pytest.mark.parametrize(
    "body, status",
    [
        ("raise ReconstructionError('too few features in 2 images')", "failed"),
        ("raise ReconstructionError('\\x1b[31mred')", "failed"),
        ("raise KeyError('a line of\\nmine')", "crashed"),
        ("os.abort()", "crashed"),
        ("os.kill(os.getpid(), signal.SIGRTMIN + 5)", "crashed"),
        ("print('last words'); os.kill(os.getpid(), signal.SIGKILL)", "crashed"),
        ("sys.exit(0)", "crashed"),
        ("np.zeros((10**7, 10**7))", "crashed"),
        ("raise OSError(errno.ENOSPC, 'No space left on device')", "crashed"),
        ("raise OSError(errno.EFBIG, 'File too large')", "crashed"),
        ("return None", "garbage"),
        ("return scene.points", "garbage"),
        ("return Reconstruction(np.zeros((5, 3)), 'metric')", "failed"),
        ("return Reconstruction(Cloud(np.full((5, 3), np.nan)), 'metric')", "failed"),
        ("return Reconstruction(scene.points, 'feet')", "failed"),
        (
            "return Reconstruction(scene.points, 'metric', {'a\\nb': replace(scene.cameras['0.png'], name='a\\nb')})",
            "garbage",
        ),
        (  # the camera's own name is checked too, because the camera is written under it
            "return Reconstruction(scene.points, 'metric', {'0.png': replace(scene.cameras['0.png'], name='9.png')})",
            "garbage",
        ),
    ],
    ids=[
        *("error", "control character", "crash", "abort", "unnamed signal", "kill", "exit", "memory"),
        *("full disk", "large file", "nothing"),
        *("a cloud", "an array", "no numbers", "gauge", "camera", "name of a camera"),
    ],
)
def test_failures_are_reported_as_results(scene, plugin, tmp_path, body, status):
    ends_process = re.match(r"os\.(abort|kill)|print|sys\.exit|np\.zeros", body)
    with nullcontext() if ends_process else reconstructing_here():
        result = run(ReconstructionJob(plugin(body), scene), tmp_path / "work")
    assert result.status == status
    assert result.reconstruction is None
    with check_error(ReconstructionError) as caught:
        result.require_reconstruction()
    assert f"{status}: {result.message}" in str(caught.value)
    assert "log.txt" in str(caught.value)


def test_a_crash_names_the_limit_of_files(scene, plugin, tmp_path, monkeypatch):
    """Libraries give other reasons: that of SQLite is that no database factory succeeded."""
    monkeypatch.setattr(runs, "file_size_limit", lambda: 51_200)
    body = "raise RuntimeError('No registered database factory')"
    assert "50 KiB" in check_text(run(ReconstructionJob(plugin(body), scene), tmp_path / "work").message)


def test_hanging_plugin_is_ended_with_its_children(scene, plugin, tmp_path):
    body = "import subprocess; p = subprocess.Popen(['sleep', '600']); print(p.pid); time.sleep(600)"
    result = run(ReconstructionJob(plugin(body), scene), tmp_path / "work", time_limit_s=3)
    assert result.status == "timeout"
    assert " 3 s" in check_text(result.message)
    assert result.wall_s < 60
    child_pid = int(result.log.read_text())
    assert has_ended(child_pid)


def test_old_result_is_not_used_after_a_crash(scene, plugin, tmp_path):
    assert run(ReconstructionJob(plugin(VALID_BODY), scene), tmp_path / "work").status == "ok"
    result = run(ReconstructionJob(plugin("os.abort()"), scene), tmp_path / "work")
    assert (result.status, result.reconstruction) == ("crashed", None)


@pytest.mark.long
def test_invalid_jobs_are_refused(scene, plugin, tmp_path):
    spec = plugin(
        VALID_BODY, "n: int = 2\nflag: bool = False\nhow: Literal['a', 'b'] = 'a'\nmaybe: float | None = None"
    )

    def check_refusal(job):
        result = run(job, tmp_path / "work")
        assert result.status == "refused"
        with check_error():
            result.require_reconstruction()

    check_refusal(ReconstructionJob(spec, scene, {"m": "1"}))
    check_refusal(ReconstructionJob(spec, scene, {"n": "two"}))
    check_refusal(ReconstructionJob(spec, scene, {"how": "c"}))
    check_refusal(ReconstructionJob(spec.replace(":Mine", ":Yours"), scene))
    with pytest.raises(InputError, match="'nobody'"):  # followed by the installed names
        run(ReconstructionJob("nobody", scene), tmp_path / "work").require_reconstruction()
    check_refusal(ReconstructionJob(spec, tmp_path / "nowhere"))
    (tmp_path / "broken.py").write_text("import numpy\n1 / 0\n")
    check_refusal(ReconstructionJob(f"{tmp_path}/broken.py:A", scene))
    check_refusal(ReconstructionJob(plugin(VALID_BODY, "@classmethod\ndef missing(cls): return 1 / 0"), scene))


def test_settings_are_converted(plugin):
    fields = "n: int = 2\nx: float = 1\nflag: bool = False\nhow: Literal['a', 'b'] = 'a'\nmaybe: float | None = None"
    reconstructor = find_plugin(plugin(VALID_BODY, fields + "\nwhere: Path = Path('.')"))
    instance = reconstructor.configure(
        {"n": "5", "x": "1e-3", "flag": "yes", "how": "b", "maybe": "2", "where": "/tmp"}
    )
    assert (instance.n, instance.x, instance.flag, instance.how, instance.maybe, instance.where) == (
        5,
        1e-3,
        True,
        "b",
        2.0,
        Path("/tmp"),
    )
    assert reconstructor.configure({"maybe": "none"}).maybe is None
    assert reconstructor.configure({"flag": "off"}).flag is False
    assert [(s.name, s.type, s.default) for s in reconstructor.settings][2:5] == [
        ("flag", "bool", "False"),
        ("how", "a|b", "a"),
        ("maybe", "float|none", "None"),
    ]
    for name, text in (("flag", "maybe"), ("n", "1.5"), ("maybe", "much")):
        with check_error():
            reconstructor.configure({name: text})
    with check_error():
        find_plugin(plugin(VALID_BODY, "n: int\ndef __post_init__(self): 1 / self.n")).configure({"n": "0"})


@pytest.mark.parametrize("text", ["99999999999999999999", "2147483648", "-2147483649", "9" * 5000, "1_" + "0" * 30])
def test_integer_settings_have_32_bits(plugin, text):
    """C++ libraries refuse larger ones with unreadable messages."""
    reconstructor = find_plugin(plugin(VALID_BODY, "n: int = 2\nmaybe: int | None = None"))
    assert reconstructor.configure({"n": "2147483647"}).n == 2**31 - 1
    for name in ("n", "maybe"):
        with check_error() as caught:
            reconstructor.configure({name: text})
        assert len(str(caught.value)) < 200


def test_help_is_the_docstring(plugin):
    assert find_plugin(plugin(VALID_BODY)).help == ""  # not the signature that Python generates for dataclasses
    assert find_plugin(plugin(VALID_BODY, '"""What it\n    does.\n\n    More."""')).help == "What it does."


def test_required_settings_are_named(plugin):
    reconstructor = find_plugin(plugin(VALID_BODY, "n: int"))
    assert reconstructor.settings[0].default is None
    with check_error():
        reconstructor.configure({})


def test_invalid_reconstructors_are_refused(tmp_path):
    (tmp_path / "a.py").write_text("class A:\n    def reconstruct(self, scene, workspace): ...\nB = 3\n")
    (tmp_path / "c.py").write_text(f"{IMPORTS}\n@dataclass\nclass A:\n    def reconstruct(self, scene): ...\n")
    (tmp_path / "d.py").write_text("class A\n")
    for file, name in (("a", "A"), ("a", "B"), ("a", "C"), ("b", "A"), ("c", "A"), ("d", "A")):
        with check_error():
            find_plugin(f"{tmp_path}/{file}.py:{name}")
    with pytest.raises(InputError, match="nowhere"):  # Python's reason follows
        find_plugin("nowhere:A")


def test_entry_points(monkeypatch):
    entry_points = [EntryPoint("one", "a:A", "g"), EntryPoint("two", "a:A", "g"), EntryPoint("two", "b.c:C", "g")]
    monkeypatch.setattr("pcbench.io.named_code.entry_points", lambda group: entry_points)
    assert plugins.installed_reconstructors() == ("one", "two")
    with check_error():
        find_plugin("two")
    with check_error():
        find_plugin("three")


def test_killed_run_resumes(scene, plugin, tmp_path):
    body = """
def slow(folder):
    print("slow stage")
    np.save(folder / "points.npy", scene.points.points)
folder = stage(workspace, "slow", {"scene": scene.fingerprint()}, slow)
if not (workspace / "again").exists():
    (workspace / "again").touch()
    os.kill(os.getpid(), signal.SIGKILL)
return Reconstruction(Cloud(np.load(folder / "points.npy")), "arbitrary")
"""
    job = ReconstructionJob(plugin(body), scene)
    killed_run = run(job, tmp_path / "work")
    assert (killed_run.status, killed_run.log.read_text()) == ("crashed", "slow stage\n")
    resumed_run = run(job, tmp_path / "work")
    assert (resumed_run.status, resumed_run.log.read_text()) == ("ok", "")
    np.testing.assert_array_equal(resumed_run.require_reconstruction().cloud.points, POINTS)


def test_survey_residuals_are_returned(scene, plugin, tmp_path):
    body = """
    from pcbench.registration import SurveyResiduals
    found = SurveyResiduals.of(["a", "b"], np.array([[0.1, 0.2, 0.3], [1, 2, 3]]), [False, True], z_is_up=True)
    return Reconstruction(scene.points, "georeferenced", residuals=found)
    """
    reconstruction = run(
        ReconstructionJob(plugin(textwrap.dedent(body)), scene), tmp_path / "work"
    ).require_reconstruction()
    assert reconstruction.residuals == SurveyResiduals.of(
        ["a", "b"], np.array([[0.1, 0.2, 0.3], [1, 2, 3]]), [False, True], z_is_up=True
    )
    outcome_file = tmp_path / "work/outcome.json"
    outcome_file.write_text(outcome_file.read_text().replace('"dx"', '"d"'))
    with check_error(ValueError):
        read_reconstruction(tmp_path / "work")


def test_invalid_reconstruction_is_refused():
    cloud = Cloud(POINTS)
    with check_error():
        Reconstruction(cloud, "metric", ["a"])
    assert Reconstruction(cloud, "metric").cameras == Reconstruction(cloud, "metric", cameras=None).cameras == {}


def test_child_can_read_the_images(scene, plugin, tmp_path):
    result = run(
        ReconstructionJob(plugin("print(scene.read_image('2.png')[0, 0]);" + VALID_BODY), scene), tmp_path / "work"
    )
    assert result.log.read_text() == "[2 0 0]\n"
    assert read_image_header(scene / "images/2.png").width == 40


def test_file_is_refused_as_workspace(scene, plugin, tmp_path, request):
    run_cli = request.getfixturevalue("run")
    (tmp_path / "work").write_text("mine")
    spec = plugin("return Reconstruction(scene.points, 'metric')")
    code, _, err = run_cli("reconstruct", spec, scene, "-o", tmp_path / "cloud.ply", "--workspace", tmp_path / "work")
    assert (code, (tmp_path / "work").read_text()) == (2, "mine")
    check_text(err)


def test_foreign_folder_is_refused_as_workspace(scene, plugin, tmp_path, request):
    run_cli = request.getfixturevalue("run")  # the fixture, not pcbench.plugins.run.run
    workspace = tmp_path / "work"
    (workspace / "cameras").mkdir(parents=True)
    (workspace / "cameras" / "mine.txt").write_text("mine")
    out = tmp_path / "cloud.ply"
    spec = plugin("return Reconstruction(scene.points, 'metric')")
    code, _, err = run_cli("reconstruct", spec, scene, "-o", out, "--workspace", workspace)
    assert code == 2
    check_text(err)
    assert (workspace / "cameras" / "mine.txt").read_text() == "mine"
    old_files = sorted((scene / "sparse").iterdir())
    code, _, err = run_cli("reconstruct", spec, scene, "-o", out, "--write-cameras", scene / "sparse")
    assert (code, sorted((scene / "sparse").iterdir())) == (2, old_files)
    check_text(err)
    for _ in range(2):  # a reconstruction's workspace may be used again
        assert run_cli("reconstruct", spec, scene, "-o", out, "--workspace", tmp_path / "new")[0] == 0
