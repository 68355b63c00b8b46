"""Scores methods, measures their costs, and writes tables of both."""
