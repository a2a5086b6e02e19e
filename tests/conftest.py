"""Fixtures and hooks that several test files use."""

import gc
import os
import random
import signal
import sys
from functools import cache

from data_folder import data_root

# Set before numpy is imported: test workers share the cores, and threads on small matrices would block each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# As in the Makefile: workers and child processes read compiled modules, also where the environment says otherwise.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", None):
    sys.dont_write_bytecode = False

# Shells make background jobs ignore Ctrl-C, and children inherit that; but some tests send Ctrl-C.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest
import wording
from budgets import checked_candidate
from partial_comparisons import skip_changes, skip_deformation

from pcbench import cli
from pcbench.cli import messages
from pcbench.comparison import pipeline
from pcbench.errors import MissingExtra
from pcbench.geometry import mesh_samples
from pcbench.opengl import NoFiguresError
from pcbench.report.plotters.window import check_window
from pcbench.scenes.synthetic.render import check_renderer

GOLDEN_TEXTS, RENEWED_TEXTS = pytest.StashKey[wording.Texts](), pytest.StashKey[wording.Texts | None]()


def pytest_addoption(parser):
    parser.addoption("--renew-wording", action="store_true", help="write tests/wording.txt anew (see tests/wording.py)")
    parser.addoption("--renew-pictures", action="store_true", help="write tests/pictures/ anew (see tests/pictures.py)")
    parser.addoption("--shuffle", type=int, metavar="SEED", help="run files and their tests in random order")


def pytest_report_header(config):
    seed = config.option.shuffle
    order = [] if seed is None else [f"random order: --shuffle={seed}"]
    return [f"real data: {data_root() or 'none (set PCBENCH_DATA)'}", *order]


def pytest_collection_modifyitems(config, items):
    """Shuffle files and the tests within each; tests of a file stay together because they share fixtures."""
    if config.option.shuffle is None:
        return
    rng = random.Random(config.option.shuffle)  # the same in every worker
    files = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    order = rng.sample(sorted(files), len(files))
    items[:] = [item for file in order for item in rng.sample(files[file], len(files[file]))]


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Collect tests without searching for garbage: tests and modules stay, and would be searched again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Send files with module-scoped fixtures or caches to one worker, which fills them once; distribute other tests.

    `--dist loadscope` would keep all files together, so the longest would determine the duration of the suite;
    `loadgroup` of pytest-xdist 3.8 has no effect under pytest 9.2.
    """
    from xdist.scheduler import LoadScopeScheduling

    class Scheduler(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            file = nodeid.partition("::")[0]
            return file if _shares_fixtures(config.rootpath / file) else nodeid

        def mark_test_complete(self, node, item_index, duration=0):
            """Forget finished units: LoadScopeScheduling counts the pending tests of all units after each test."""
            test = self.registered_collections[node][item_index]
            scope, units = self._split_scope(test), self.assigned_work[node]
            units[scope][test] = True
            if all(units[scope].values()):
                del units[scope]
            self._reschedule(node)

        def remove_node(self, node):
            """Do not repeat the test that ended the worker, as one does that hangs."""
            units = self.assigned_work[node].values()
            unit, ended = next(((unit, test) for unit in units for test in unit if not unit[test]), (None, None))
            if unit is not None:
                unit[ended] = True
            super().remove_node(node)
            return ended

    return Scheduler(config, log)


def pytest_configure(config):
    config.stash[GOLDEN_TEXTS] = wording.read()
    config.stash[RENEWED_TEXTS] = {} if config.getoption("--renew-wording") else None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    with wording.texts_of(item.nodeid, item.config.stash[GOLDEN_TEXTS], item.config.stash[RENEWED_TEXTS]):
        return (yield)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    """Collect the renewed texts of a pytest-xdist worker that has ended."""
    if node.config.stash[RENEWED_TEXTS] is not None:
        wording.add(node.config.stash[RENEWED_TEXTS], node.workeroutput.get("wording", {}))


def pytest_sessionfinish(session):
    renewed = session.config.stash[RENEWED_TEXTS]
    if renewed is None:
        return
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["wording"] = renewed
    else:
        wording.renew(renewed)


@cache
def _shares_fixtures(file):
    text = file.read_text(encoding="utf-8")
    return 'fixture(scope="module")' in text or "\n@cache\n" in text


@pytest.fixture(scope="session")
def renew_pictures(request):
    """Return whether golden pictures are written anew."""
    return request.config.getoption("--renew-pictures")


@pytest.fixture(scope="session")
def renderer():
    """Skip tests that render photographs on machines without a renderer."""
    try:
        check_renderer()
    except (NoFiguresError, MissingExtra) as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def off_screen():
    """Skip tests that render with pyvista on machines where that fails; a child process tries it."""
    try:
        check_window(off_screen=True)
    except (NoFiguresError, MissingExtra) as error:
        pytest.skip(str(error))


@pytest.fixture(autouse=True)
def _no_progress(monkeypatch):
    """Suppress progress lines of commands in this process, so that their output does not depend on time."""
    monkeypatch.setattr(messages, "_MESSAGE_INTERVAL_S", 3600.0)


@pytest.fixture(scope="session", autouse=True)
def _budgets_add_up():
    """Check in each comparison of the suite that the parts of D2 add up to D2."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "Candidate", checked_candidate)
        yield


@pytest.fixture
def without_deformation(monkeypatch):
    """Let comparisons test no deformation, which takes half of their time."""
    skip_deformation(monkeypatch)


@pytest.fixture
def without_changes(monkeypatch):
    """Let comparisons search for no changes."""
    skip_changes(monkeypatch)


@pytest.fixture
def few_samples(monkeypatch):
    """Represent a mesh as the reference by 20,000 points, in place of a million."""
    monkeypatch.setattr(mesh_samples, "REFERENCE_SAMPLES", 20_000)


@pytest.fixture
def run(monkeypatch, capsys):
    """Return a function that calls the command line in this process: (exit code, stdout, stderr), not line-wrapped."""
    monkeypatch.delenv("COLUMNS", raising=False)

    def call(*arguments, figures=False):
        if arguments[0] == "compare" and not figures:
            arguments = (*arguments, "--no-figures")
        monkeypatch.setattr(sys, "argv", ["pcbench", *map(str, arguments)])
        try:
            cli.main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call
