"""pytest plugin: what tests measured, printed at the end of the run, whichever of several processes measured it."""

from __future__ import annotations

import pytest

PROPERTY = "figure"
"""`record_property(PROPERTY, "a line")`."""


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [report for reports in terminalreporter.stats.values() for report in reports]
    lines = [
        str(value)
        for report in reports
        if isinstance(report, pytest.TestReport) and report.when == "teardown"
        for name, value in report.user_properties
        if name == PROPERTY
    ]
    if lines:
        terminalreporter.section("measured")
        for line in lines:
            terminalreporter.write_line(line)
