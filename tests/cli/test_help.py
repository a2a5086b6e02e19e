"""The help of all commands: groups of options, and its length."""

import click
import pytest
from click.testing import CliRunner

from pcbench.cli import app
from pcbench.options import OptionGroup

SCREEN = 80, 50  # columns and lines of a small terminal
MAX_FIRST_OPTIONS = 6  # of a command with groups, besides --help


def _commands(group, *words):
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from _commands(command, *words, name)
        else:
            yield (*words, name)


def _help(*words):
    result = CliRunner().invoke(app, [*words, "--help"], terminal_width=SCREEN[0])
    assert result.exit_code == 0
    return result.output.splitlines()


@pytest.mark.parametrize("words", [*_commands(app)], ids=" ".join)
def test_help_fits_two_screens_and_the_options_that_matter_come_first(words):
    lines = _help(*words)
    assert len(lines) <= 2 * SCREEN[1]
    titles = [line[:-1] for line in lines if line.endswith(":") and not line.startswith(" ")]
    assert titles == ["Options", *(group for group in OptionGroup if group in titles)]
    first = lines[lines.index("Options:") + 1 :]
    if len(titles) > 1:
        first = first[: first.index("")]
    names = [line for line in first if line.startswith("  -")]
    assert len(names) - 1 <= MAX_FIRST_OPTIONS


def test_each_command_is_in_a_section():
    listed = [command.name for commands in app.sections.values() for command in commands]
    assert sorted(listed) == sorted(app.commands)
    assert len(_help()) <= SCREEN[1]


def test_pcbench_alone_shows_three_examples():
    result = CliRunner().invoke(app, [])
    assert sum(line.startswith("  pcbench ") for line in result.output.splitlines()) == 3


def test_the_help_of_scene_names_all_files_of_cameras():
    text = " ".join(CliRunner().invoke(app, ["scene", "--help"]).output.split())
    for name in ("COLMAP", "transforms.json", ".camera", "OpenMVS", "Earth Studio", "cameras.json", "Metashape"):
        assert name in text
