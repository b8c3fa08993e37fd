"""`Recording`: what was recorded of a person, and its folder format."""
