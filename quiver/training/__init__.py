"""Trains all networks by one loop."""
