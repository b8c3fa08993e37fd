"""Report of a reconstruction as one HTML page: its sections, and the document that holds them."""

from rtof_kin.reporting.page.document import PAGE, report

__all__ = ["PAGE", "report"]
