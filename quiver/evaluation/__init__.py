"""Scores, costs and tables."""
