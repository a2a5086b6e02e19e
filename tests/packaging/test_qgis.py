"""The QGIS plugin with stand-ins for the classes of QGIS: its commands are ones that pcbench accepts."""

import sys
from importlib import util
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from repository import ROOT

from pcbench.cli import app
from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud

PLUGIN = ROOT / "packaging/qgis/pcbench_algorithms/__init__.py"


class Algorithm:
    """QgsProcessingAlgorithm: parameters are a dict of their values."""

    def __init__(self):
        self.names, self.outputs = [], []

    def addParameter(self, parameter):
        self.names.append(parameter.name)

    def addOutput(self, output):
        self.outputs.append(output.name)

    def parameterAsString(self, parameters, name, context):
        assert name in self.names
        return str(parameters.get(name, ""))

    def parameterAsEnum(self, parameters, name, context):
        return parameters.get(name, 0)

    def parameterAsDouble(self, parameters, name, context):
        return float(parameters.get(name, 0))

    def parameterAsFileList(self, parameters, name, context):
        return [str(path) for path in parameters[name]]


class Definition(SimpleNamespace):
    """A parameter, an output, or another class of QGIS: its first argument is its name."""

    Double, TypeFile = 1, 2

    def __init__(self, name="", *arguments, **settings):
        super().__init__(name=name, **settings)


class Feedback:
    def __init__(self, cancels=False):
        self.lines, self.cancels = [], cancels

    def pushConsoleInfo(self, line):
        self.lines.append(line)

    def pushCommandInfo(self, line):
        self.lines.append(line)

    def isCanceled(self):
        return self.cancels


@pytest.fixture
def plugin(monkeypatch):
    core = ModuleType("qgis.core")
    core.__getattr__ = lambda name: Definition
    core.QgsProcessingAlgorithm = Algorithm
    core.QgsProcessingException = type("QgsProcessingException", (Exception,), {})
    monkeypatch.setitem(sys.modules, "qgis", ModuleType("qgis"))
    monkeypatch.setitem(sys.modules, "qgis.core", core)
    specification = util.spec_from_file_location("pcbench_algorithms", PLUGIN)
    module = util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture
def clouds(tmp_path):
    rng = np.random.default_rng(3)
    for year in (2019, 2023):
        write_cloud(tmp_path / f"site_{year}.ply", Cloud(np.c_[rng.uniform(0, 9, (300, 2)), rng.normal(0, 0.1, 300)]))
    return [tmp_path / "site_2019.ply", tmp_path / "site_2023.ply"]


def parsed(arguments):
    """Return the values that pcbench's command reads from its arguments."""
    command, *rest = arguments
    return app.commands[command].make_context(command, list(rest)).params


def test_commands_are_read_as_intended(plugin, clouds, tmp_path):
    first, second = clouds
    zones = tmp_path / "zones.geojson"
    zones.write_text("{}")
    compare, change = plugin.Compare(), plugin.Change()
    for algorithm in (compare, change):
        algorithm.initAlgorithm()
        assert algorithm.names[-1] == "OUT" and algorithm.outputs == ["PAGE"]
    common = {"OUT": tmp_path / "out", "CLASSES": "2,6"}
    values = parsed(
        ["compare", *compare.arguments({"REFERENCE": first, "CANDIDATE": second, "REGISTER": 3} | common, 0)]
    )
    assert (str(values["reference"]), values["register"]) == (str(first), "none")
    values = parsed(
        ["change", *change.arguments({"BEFORE": first, "AFTER": [second], "CELL": 0.5, "ZONES": zones} | common, 0)]
    )
    assert (values["cell"], str(values["zones"]), values["stable"]) == (0.5, str(zones), None)


def test_every_registration_is_a_method_of_pcbench(plugin, clouds, tmp_path):
    compare = plugin.Compare()
    compare.initAlgorithm()
    for k, method in enumerate(compare.METHODS):
        parameters = {"REFERENCE": clouds[0], "CANDIDATE": clouds[1], "REGISTER": k, "OUT": tmp_path / "out"}
        assert parsed(["compare", *compare.arguments(parameters, None)])["register"] == method


def test_program_runs_and_its_failure_is_an_exception(plugin, tmp_path):
    """A stand-in for the program prints its arguments; one that fails or is cancelled raises an exception."""
    program = tmp_path / "pcbench"
    program.write_text('#!/bin/sh\necho "ran $1"\n')
    program.chmod(0o755)
    change, feedback = plugin.Change(), Feedback()
    change.initAlgorithm()
    parameters = {"PROGRAM": program, "BEFORE": "a.ply", "AFTER": ["c.ply", "b.ply"], "OUT": tmp_path / "out"}
    assert change.processAlgorithm(parameters, None, feedback)["PAGE"] == str(tmp_path / "out" / "report.html")
    assert feedback.lines[-1] == "ran change" and " a.ply b.ply c.ply " in feedback.lines[0]
    for script, cancels in (("echo broken; exit 2", False), ("exec sleep 60", True)):
        program.write_text(f"#!/bin/sh\n{script}\n")
        with pytest.raises(Exception, match="exit code"):
            change.processAlgorithm(parameters, None, Feedback(cancels))
