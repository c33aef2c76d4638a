"""One self-contained HTML file; computes nothing."""

from rangecheck.report.page import Figure, Finding, ReportContent, Section, Turntable, write_report

__all__ = ["Figure", "Finding", "ReportContent", "Section", "Turntable", "write_report"]
