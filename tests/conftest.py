"""What several test files use."""

import os
import random
import signal
import sys
from functools import cache

from data_folder import data_root

# Before numpy is imported. Workers share the cores, and the matrices are small: threads would wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# A shell tells what it starts in the background to ignore Ctrl-C, and children inherit that: tests send it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest
import wording

from pcbench import cli
from pcbench.cli import messages
from pcbench.errors import MissingExtra
from pcbench.opengl import NoFiguresError
from pcbench.scenes.synthetic.render import check_renderer

GOLDEN, RENEWED = pytest.StashKey[wording.Texts](), pytest.StashKey[wording.Texts | None]()


def pytest_addoption(parser):
    parser.addoption("--renew-wording", action="store_true", help="write tests/wording.txt anew (see tests/wording.py)")
    parser.addoption("--shuffle", type=int, metavar="SEED", help="run files and their tests in random order")


def pytest_report_header(config):
    seed = config.option.shuffle
    order = [] if seed is None else [f"random order: --shuffle={seed}"]
    return [f"real data: {data_root() or 'none (set PCBENCH_DATA)'}", *order]


def pytest_collection_modifyitems(config, items):
    """Tests of a file stay together: what they share is made once."""
    if config.option.shuffle is None:
        return
    rng = random.Random(config.option.shuffle)  # the same in every worker
    files = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    order = rng.sample(sorted(files), len(files))
    items[:] = [item for file in order for item in rng.sample(files[file], len(files[file]))]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A file whose tests share a module's fixture goes to one worker, which builds it once; other tests go one by one.

    With `--dist loadscope` every file would stay whole, and the longest decide how long the suite takes; `loadgroup`
    of pytest-xdist 3.8 does nothing under pytest 9.2.
    """
    from xdist.scheduler import LoadScopeScheduling

    class Scheduler(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            file = nodeid.partition("::")[0]
            return file if _shares_fixtures(config.rootpath / file) else nodeid

    return Scheduler(config, log)


def pytest_configure(config):
    config.stash[GOLDEN] = wording.read()
    config.stash[RENEWED] = {} if config.getoption("--renew-wording") else None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    with wording.spoken_by(item.nodeid, item.config.stash[GOLDEN], item.config.stash[RENEWED]):
        return (yield)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    """A worker of pytest-xdist has ended: its renewed texts are taken over."""
    if node.config.stash[RENEWED] is not None:
        node.config.stash[RENEWED] |= node.workeroutput.get("wording", {})


def pytest_sessionfinish(session):
    renewed = session.config.stash[RENEWED]
    if renewed is None:
        return
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["wording"] = renewed
    else:
        wording.renew(renewed)


@cache
def _shares_fixtures(file):
    return 'fixture(scope="module")' in file.read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def renderer():
    """Skips what takes photographs where none can be taken."""
    try:
        check_renderer()
    except (NoFiguresError, MissingExtra) as error:
        pytest.skip(str(error))


@pytest.fixture(autouse=True)
def _no_progress(monkeypatch):
    """Commands called in this process do not tell how far they are: what they print depends on no clock."""
    monkeypatch.setattr(messages, "_MESSAGE_INTERVAL_S", 3600.0)


@pytest.fixture
def run(monkeypatch, capsys):
    """Call the command line in this process: (exit code, stdout, stderr). Sentences are not broken into lines."""
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
