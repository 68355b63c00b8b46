"""Describes bodies that bones and morph targets deform, and reads them from glTF files."""
