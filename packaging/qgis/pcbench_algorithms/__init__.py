"""QGIS plugin with two Processing algorithms, which run `pcbench compare` and `pcbench change` on files.

It is a plugin because a Processing script has one algorithm. A copy of this folder in the profile's python/plugins
makes it known to QGIS. It imports nothing of pcbench: the command runs in its own Python. It was never run in QGIS.
tests/packaging/test_qgis.py runs it with stand-ins for the classes of QGIS, and checks its commands against pcbench's.
"""

import os
import shutil
import subprocess
import threading
from pathlib import Path

from qgis.core import (
    QgsApplication,
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingOutputFile,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
    QgsProcessingProvider,
)


class Pcbench(QgsProcessingAlgorithm):
    """An algorithm that runs a pcbench command and writes a report folder."""

    COMMAND = TITLE = HELP = ""

    def name(self):
        return self.COMMAND

    def displayName(self):
        return self.TITLE

    def shortHelpString(self):
        return self.HELP

    def createInstance(self):
        return type(self)()

    def add_common_parameters(self):
        """Add what both commands have: classes, further options, the report folder, and its page as output."""
        self.addParameter(
            QgsProcessingParameterString("CLASSES", "Classes of LAS files, such as 2,6 (empty: all)", optional=True)
        )
        executable = "Program pcbench (empty: found on the PATH)"
        self.addParameter(QgsProcessingParameterFile("PROGRAM", executable, optional=True))
        self.addParameter(QgsProcessingParameterFolderDestination("OUT", "Report folder"))
        self.addOutput(QgsProcessingOutputFile("PAGE", "Report page"))

    def common_arguments(self, parameters, context):
        """Return the options of the common parameters."""
        classes = self.parameterAsString(parameters, "CLASSES", context)
        out = self.parameterAsString(parameters, "OUT", context)
        return [*(["--classes", classes] if classes else []), "--no-figures", "--out", out]

    def processAlgorithm(self, parameters, context, feedback):
        """Run the command; its lines appear in the log, and Cancel ends it."""
        program = self.parameterAsString(parameters, "PROGRAM", context) or shutil.which("pcbench")
        if not program:
            raise QgsProcessingException("pcbench was not found: install it by pip, or state the program")
        command = [program, self.COMMAND, *self.arguments(parameters, context)]
        feedback.pushCommandInfo(subprocess.list2cmdline(command))
        run(command, feedback)
        out = self.parameterAsString(parameters, "OUT", context)
        return {"OUT": out, "PAGE": str(Path(out) / "report.html")}


class Compare(Pcbench):
    """`pcbench compare`: distances of candidates from a reference, in both directions."""

    COMMAND, TITLE = "compare", "Compare point clouds"
    HELP = "Registers a point cloud to a reference and measures the distances between them in both directions."
    METHODS = ("icp", "similarity", "global", "none")

    def initAlgorithm(self, configuration=None):
        self.addParameter(QgsProcessingParameterFile("REFERENCE", "Reference"))
        self.addParameter(QgsProcessingParameterFile("CANDIDATE", "Candidate"))
        self.addParameter(
            QgsProcessingParameterEnum("REGISTER", "Registration", options=list(self.METHODS), defaultValue=0)
        )
        self.add_common_parameters()

    def arguments(self, parameters, context):
        """Return the arguments of the command."""
        clouds = [self.parameterAsString(parameters, name, context) for name in ("REFERENCE", "CANDIDATE")]
        method = self.METHODS[self.parameterAsEnum(parameters, "REGISTER", context)]
        return [*clouds, "--register", method, *self.common_arguments(parameters, context)]


class Change(Pcbench):
    """`pcbench change`: change of height and volumes between epochs."""

    COMMAND, TITLE = "change", "Change between epochs"
    HELP = "Measures change of height and volumes between an epoch and later ones, in the order of their file names."

    def initAlgorithm(self, configuration=None):
        self.addParameter(QgsProcessingParameterFile("BEFORE", "Epoch before"))
        self.addParameter(QgsProcessingParameterMultipleLayers("AFTER", "Later epochs", QgsProcessing.TypeFile))
        self.addParameter(
            QgsProcessingParameterNumber(
                "CELL", "Edge of a cell (0: by density)", QgsProcessingParameterNumber.Double, 0.0, minValue=0.0
            )
        )
        for name, title in (("ZONES", "Zones (GeoJSON or WKT)"), ("STABLE", "Stable terrain (GeoJSON or WKT)")):
            self.addParameter(QgsProcessingParameterFile(name, title, optional=True))
        self.add_common_parameters()

    def arguments(self, parameters, context):
        """Return the arguments of the command."""
        before = self.parameterAsString(parameters, "BEFORE", context)
        after = sorted(self.parameterAsFileList(parameters, "AFTER", context))
        cell = self.parameterAsDouble(parameters, "CELL", context)
        options = ["--cell", f"{cell:g}"] if cell else []
        for name in ("ZONES", "STABLE"):
            if path := self.parameterAsString(parameters, name, context):
                options += [f"--{name.lower()}", path]
        return [before, *after, *options, *self.common_arguments(parameters, context)]


def run(command, feedback):
    """Run a command until it ends or the user cancels.

    Raises:
        QgsProcessingException: it failed or was cancelled.
    """
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONHOME", "PYTHONPATH")}
    process = subprocess.Popen(  # without the paths that QGIS set for its Python
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="replace",
        env={**environment, "PYTHONUTF8": "1"},
    )
    ended = threading.Event()

    def end_if_cancelled():
        while not ended.wait(0.2):
            if feedback.isCanceled():
                process.terminate()
                return

    threading.Thread(target=end_if_cancelled, daemon=True).start()
    try:
        with process.stdout:
            for line in process.stdout:
                feedback.pushConsoleInfo(line.rstrip())
        code = process.wait()
    finally:
        ended.set()
    if code:
        raise QgsProcessingException(f"pcbench ended with exit code {code}; its message is in the log")


class Provider(QgsProcessingProvider):
    """The group `pcbench` in the toolbox of Processing."""

    def id(self):
        return "pcbench"

    def name(self):
        return "pcbench"

    def loadAlgorithms(self):
        for algorithm in (Compare(), Change()):
            self.addAlgorithm(algorithm)


class Plugin:
    """Adds the provider while the plugin is active."""

    def __init__(self):
        self.provider = None

    def initProcessing(self):
        self.provider = Provider()
        QgsApplication.processingRegistry().addProvider(self.provider)

    def initGui(self):
        self.initProcessing()

    def unload(self):
        QgsApplication.processingRegistry().removeProvider(self.provider)


def classFactory(interface):
    """Return the plugin; QGIS calls this function."""
    return Plugin()
