"""The command line: parse arguments, and turn errors into one line. Slow modules are imported only by commands."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Any, NoReturn

import click

from pcbench import __version__
from pcbench.cli import (
    change,
    checkpoints,
    clouds,
    convert,
    evaluate,
    experiments,
    quality,
    reconstruction,
    reports,
    scenes,
    stress,
    studies,
    tradeoff,
    view,
)
from pcbench.cli.help import CommandLine, option
from pcbench.cli.log import LOGGER, end_log, log_settings, start_log
from pcbench.cli.messages import fail
from pcbench.cli.options import FILE
from pcbench.cli.streams import discard, finish_errors, finish_output, is_of_a_stream, prepare_streams
from pcbench.errors import PcbenchError, lacks_files, reason_of
from pcbench.threads import limit_threads


@click.group(cls=CommandLine, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="pcbench")
@option("--log", type=FILE, metavar="FILE", help="Log steps, settings, versions, warnings and errors to FILE.")
def app(log: Path | None) -> None:
    """How far is this point cloud from that one, where, why, and which numbers can be trusted?

    \b
    pcbench demo                                       try it on a small city
    pcbench compare ref.ply a.ply b.ply --out report/  measure two clouds
    pcbench change 2019.laz 2023.laz --out change/     measure what moved
    """
    if log is not None:
        start_log(log)


_SECTIONS: dict[str, tuple[click.Command, ...]] = {
    "Measure clouds": (
        *(reports.compare, change.change, checkpoints.checkpoints, quality.quality, reports.deform),
        *(evaluate.evaluate, tradeoff.tradeoff),
    ),
    "Look at clouds, and change them": (
        *(clouds.info, view.view, reports.plot, clouds.crop, clouds.register, convert.convert),
    ),
    "Reconstruct photographs": (
        *(scenes.scene, reconstruction.reconstruct, reconstruction.plugins, studies.bench, studies.views),
    ),
    "Test with exact truth": (studies.demo, scenes.synth, stress.stress, experiments.experiment),
}

for _title, _commands in _SECTIONS.items():
    for _command in _commands:
        log_settings(_command)
    app.add_section(_title, *_commands)

_BROKEN_PIPE = 1  # exit code of click after a broken pipe; pcbench never uses it


def main() -> None:
    """Run the command line; a user error is one line on stderr and exit code 2, any other error keeps its traceback."""
    prepare_streams()
    for name in ("SIGTERM", "SIGHUP"):  # batch systems send these: clean up as after Ctrl-C
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _stop)
    try:
        _run()
    except SystemExit as stop:
        if stop.code == _BROKEN_PIPE:
            _end_without_reader()
        raise
    except BrokenPipeError:
        _end_without_reader()
    except Exception:
        LOGGER.critical("internal error", exc_info=True)
        raise
    finally:
        end_log()
        finish_errors()


def _run() -> None:
    try:
        limit_threads()
        app(prog_name="pcbench", standalone_mode=False)
        finish_output()
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx else "pcbench"
        fail(f"{error.format_message()} (see {command} --help)")
    except (click.Abort, KeyboardInterrupt):
        LOGGER.error("interrupted", exc_info=True)
        click.echo("interrupted", err=True)
        sys.exit(130)
    except BrokenPipeError:
        raise
    except OSError as error:
        if is_of_a_stream(error):
            discard(sys.stdout)
            fail(f"standard output: {error.strerror}")
        if isinstance(error, FileNotFoundError) and error.filename is None:
            fail("the current folder no longer exists: change to another one")
        if lacks_files(error):
            fail(reason_of(error))
        fail(f"{error.filename}: {reason_of(error)}" if error.filename and error.strerror else str(error))
    except MemoryError:
        fail("not enough memory for these clouds: crop or downsample them first")
    except (PcbenchError, click.ClickException) as error:
        fail(str(error))


def _end_without_reader() -> NoReturn:
    """End without a message, because nothing reads the output any more."""
    discard(sys.stdout, sys.stderr)
    sys.exit(2)


def _stop(number: int, _: Any) -> NoReturn:
    sys.exit(128 + number)
