"""The report: one file that opens offline, made of a run's results."""

from lampopt.reporting.write import write_report

__all__ = ["write_report"]
