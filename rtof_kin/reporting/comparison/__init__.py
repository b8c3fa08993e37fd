"""Two motions, or two sides of one, beside each other: sentences, files and a page."""
