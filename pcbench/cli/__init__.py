"""The command line: arguments become calls, errors become one line. Heavy imports stand inside the commands."""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
from typing import Any, NoReturn

import click

from pcbench import __version__
from pcbench.cli import clouds, experiments, reconstruction, reports, scenes, studies
from pcbench.cli.messages import fail
from pcbench.errors import PcbenchError
from pcbench.threads import fit_threads


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="pcbench")
def app() -> None:
    """How far is this point cloud from that one, where, why, and which numbers can be trusted?"""


for _command in (
    *(reports.compare, reports.deform, reports.plot),
    *(clouds.info, clouds.crop, clouds.register, clouds.convert),
    *(scenes.scene, scenes.synth),
    *(reconstruction.plugins, reconstruction.reconstruct),
    *(studies.demo, studies.bench, studies.views, experiments.experiment),
):
    app.add_command(_command)


def main() -> None:
    """Entry point: a user's mistake is one line on stderr and exit code 2; anything else keeps its traceback."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without arrows still gets its table
            stream.reconfigure(errors="replace")
    for name in ("SIGTERM", "SIGHUP"):  # batch systems stop jobs by these: clean up as after Ctrl-C
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _stop)
    try:
        fit_threads()
        app(standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
    except click.UsageError as error:
        help_of = error.ctx.command_path if error.ctx else "pcbench"
        fail(f"{error.format_message()} (see {help_of} --help)")
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted", err=True)
        sys.exit(130)
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(2)
    except OSError as error:
        if error.filename is None and error.errno in (errno.ENOSPC, errno.EFBIG):  # files name themselves
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            fail(f"standard output: {error.strerror}")
        fail(f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error))
    except MemoryError:
        fail("not enough memory for these clouds: crop or downsample them first")
    except (PcbenchError, click.ClickException) as error:
        fail(str(error))


def _stop(number: int, _: Any) -> NoReturn:
    sys.exit(128 + number)
