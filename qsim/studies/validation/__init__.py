"""Compares sensors, rendering, backends and reading with independent references."""
