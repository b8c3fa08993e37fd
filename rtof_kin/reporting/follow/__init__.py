"""Visits of one person beside each other: sentences, files, figures and a page."""
