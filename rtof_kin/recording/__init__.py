"""`Recording`: the inputs of one take of one person, and its folder format."""
