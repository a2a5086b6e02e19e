"""A comparison as files, tables and pictures."""

from pcbench.io.json_values import to_json
from pcbench.report.answer import answer
from pcbench.report.document import document
from pcbench.report.figures import Figures
from pcbench.report.folder import report_folder, write_deformation, write_report
from pcbench.report.inputs import InputFile, Inputs
from pcbench.report.table import html, markdown, rows
from pcbench.report.terminal import print_columns, print_comparison, print_outputs, print_result
from pcbench.report.viewing import ViewingCameras

__all__ = [
    "Figures",
    "InputFile",
    "Inputs",
    "ViewingCameras",
    "answer",
    "document",
    "html",
    "markdown",
    "print_columns",
    "print_comparison",
    "print_outputs",
    "print_result",
    "report_folder",
    "rows",
    "to_json",
    "write_deformation",
    "write_report",
]
