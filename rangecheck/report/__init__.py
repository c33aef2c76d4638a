"""One self-contained HTML file; computes nothing."""

from rangecheck.report.content import (
    Coverage,
    DistanceMap,
    Field,
    Figure,
    Finding,
    Model,
    ReportContent,
    Scan,
    Turntable,
    data_uri,
)
from rangecheck.report.page import report_html, write_report

__all__ = [
    "Coverage",
    "DistanceMap",
    "Field",
    "Figure",
    "Finding",
    "Model",
    "ReportContent",
    "Scan",
    "Turntable",
    "data_uri",
    "report_html",
    "write_report",
]
