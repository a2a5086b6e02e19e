"""Progress of operations: steps, time estimates, and their display."""

import io
import sys
import time

import pytest

from pcbench.cli import messages
from pcbench.cli.messages import steps
from pcbench.progress import ProgressPlan, Step, TimeEstimate, duration

MESSAGE_INTERVAL_S = messages._MESSAGE_INTERVAL_S


def test_plan_announces_steps_with_durations():
    announcements = []
    plan = ProgressPlan(announcements.append, [1.0, 10.0, 3.0])
    plan("reading")
    inner_plan = ProgressPlan(plan.within(), [4.0, 6.0])
    inner_plan("registering")
    inner_plan("measuring")
    plan("writing")
    plan("unplanned step")
    assert announcements == ["reading", "registering", "measuring", "writing", "unplanned step"]
    assert [(step.expected, step.after) for step in announcements] == [(1, 13), (4, 9), (6, 3), (3, 0), (None, 0)]


def test_time_left_adapts_to_the_machine():
    """Four steps with an expected duration of 25 s run on a machine that takes three times as long."""
    estimate = TimeEstimate(0.0)
    for number in range(4):
        now = 75.0 * number
        estimate.begin(Step("run", 25.0, 25.0 * (3 - number)), now)
        if number:
            assert estimate.seconds_left(now) == pytest.approx(300 - now, rel=0.15)
            assert estimate.share(now) == pytest.approx(now / 300, abs=0.05)
    assert estimate.seconds_left(now + 40) < estimate.seconds_left(now + 10)


def test_slow_step_never_reaches_100_percent():
    estimate = TimeEstimate(0.0)
    estimate.begin(Step("long", 2.0, 1.0), 0.0)
    shares = [estimate.share(float(t)) for t in range(1, 100)]
    assert max(shares) < 1.0
    assert all(estimate.seconds_left(float(t)) > 1.0 for t in range(100))


def test_step_without_duration_gives_no_estimate():
    estimate = TimeEstimate(0.0)
    estimate.begin("a step without a duration", 1.0)
    assert estimate.seconds_left(5.0) is None
    assert estimate.share(5.0) is None


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.2, "1 s"),
        (89, "89 s"),
        (91, "2 min"),
        (600, "10 min"),
        (5400, "1 h 30 min"),
        (7200, "2 h"),
        (7800, "2 h 10 min"),
    ],
)
def test_duration_format(seconds, text):
    assert duration(seconds) == text


def test_short_steps_print_nothing_without_a_terminal(capsys):
    with steps(False) as step:
        step("reading")
    assert capsys.readouterr() == ("", "")


def _read_stderr_until(capsys, is_complete):
    """Return what is written to standard error until `is_complete` accepts it, or for half a minute."""
    text, end = "", time.monotonic() + 30
    while not is_complete(text) and time.monotonic() < end:
        time.sleep(0.01)
        text += capsys.readouterr().err
    return text


def test_long_steps_print_lines_without_a_terminal(capsys, monkeypatch):
    assert MESSAGE_INTERVAL_S < 10
    monkeypatch.setattr(messages, "_MESSAGE_INTERVAL_S", 0.01)
    with steps(False) as step:
        step(Step("reading a.ply", 30.0, 60.0))
        lines = _read_stderr_until(capsys, lambda text: text.count("reading a.ply (") > 2).splitlines()
        step("registering")
        next_text = _read_stderr_until(capsys, lambda text: text.count("registering\n") > 1)
    assert lines[-1] == "[0:00] reading a.ply (about 90 s left)"
    assert "[0:00] registering" in next_text
    capsys.readouterr()
    time.sleep(0.05)
    assert capsys.readouterr().err == ""


def test_quiet_runs_print_nothing(capsys, monkeypatch):
    monkeypatch.setattr(messages, "_MESSAGE_INTERVAL_S", 0.001)
    with steps(True) as step:
        step("reading")
        time.sleep(0.05)
    assert capsys.readouterr() == ("", "")


def test_terminal_shows_a_bar_with_the_time_left(monkeypatch, capsys):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    with steps(False) as step:
        step(Step("registering [a]", 30.0, 60.0))
        terminal = sys.stderr
        time.sleep(0.3)
        with step.paused():
            print("the answer")
    assert "registering [a]" in terminal.getvalue()
    assert capsys.readouterr().out == "the answer\n"  # the bar does not redirect what is printed
    assert "90 s left" in terminal.getvalue()
