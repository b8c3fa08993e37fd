"""How accurate a lifter is, from where, at what, and whether it knows."""
