"""The report of a reconstruction: what was checked (`audit`), and one page that shows everything (`page`)."""
