"""Sensors, rendering, backends and reading against independent references."""
