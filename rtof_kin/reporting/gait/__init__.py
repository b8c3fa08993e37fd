"""Gait scores: recordings that they are made from, sentences, figure and files."""
