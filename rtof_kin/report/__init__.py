"""The report of a reconstruction: what was checked (`audit`), and one page of everything (`page`)."""
