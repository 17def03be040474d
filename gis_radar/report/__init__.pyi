from .report import Report, write_report

__all__ = ["Report", "write_report"]
