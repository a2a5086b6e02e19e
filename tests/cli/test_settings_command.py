"""Options of a command that are fields of settings."""

import sys
from dataclasses import dataclass
from types import ModuleType

import click
import pytest

from pcbench.cli.settings_command import SettingsCommand
from pcbench.errors import InputError
from pcbench.measure.settings import Settings
from pcbench.options import Bounds, from_options, options_of, parse_lengths, setting


@dataclass(frozen=True)
class Extra:
    """Settings of the command below."""

    lengths: tuple[float, ...] | None = setting(None, "--lengths", "Some lengths.", metavar="T,T", parse=parse_lengths)
    names: tuple[str, ...] = setting((), "--name", "A name.", metavar="NAME", is_repeatable=True)
    share: float = setting(0.5, "--share", "A share.", bounds=Bounds(float, 0, 1), shows_default=True)
    is_quick: bool = setting(False, "--quick", "Be quick.")
    hidden: int = 7


@pytest.fixture
def command(monkeypatch):
    module = ModuleType("settings_of_a_test")
    module.Extra = Extra
    monkeypatch.setitem(sys.modules, module.__name__, module)

    @click.command(cls=SettingsCommand, settings=("settings_of_a_test:Extra",), after="out")
    @click.option("--out")
    def measure(out, **given):
        return from_options(Extra, given)

    return measure


@pytest.mark.parametrize(
    ("arguments", "settings"),
    [
        ("", Extra()),
        ("--lengths 0.1,2 --quick", Extra(lengths=(0.1, 2.0), is_quick=True)),
        ("--name a,b --name c --share 1", Extra(names=("a", "b", "c"), share=1.0)),
    ],
)
def test_fields_are_set_by_their_options(command, arguments, settings):
    assert command.main(arguments.split(), standalone_mode=False) == settings


def test_values_are_checked(command):
    for arguments in ("--share 2", "--share nan", "--hidden 3"):
        with pytest.raises(click.UsageError):
            command.main(arguments.split(), standalone_mode=False)
    with pytest.raises(InputError, match="--lengths"):
        command.main(["--lengths", "0.1;2"], standalone_mode=False)


def test_each_setting_of_a_comparison_has_an_option():
    assert set(Settings.__dataclass_fields__) - options_of(Settings).keys() == {"normal_neighbors", "initial"}
