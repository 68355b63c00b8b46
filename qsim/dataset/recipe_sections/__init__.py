"""Reads the sections of a recipe: values with their checks, and lines for error messages."""
