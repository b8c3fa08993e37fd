"""Report of a reconstruction: audit, clinical findings, figures, HTML page and exported files."""
