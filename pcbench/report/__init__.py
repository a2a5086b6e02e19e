"""A comparison as files and tables."""

from pcbench.report.document import document, to_json
from pcbench.report.folder import Inputs, report_folder, write_deformation, write_report
from pcbench.report.table import markdown, print_columns, print_table, rows

__all__ = [
    "Inputs",
    "document",
    "markdown",
    "print_columns",
    "print_table",
    "report_folder",
    "rows",
    "to_json",
    "write_deformation",
    "write_report",
]
