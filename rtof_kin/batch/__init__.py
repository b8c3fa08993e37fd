"""Batches: a chain of commands on many recordings, one row of a table for each."""
