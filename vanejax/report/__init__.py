"""One HTML file that says where the part is, and whether to believe it."""

from vanejax.report.page import write_report

__all__ = ["write_report"]
