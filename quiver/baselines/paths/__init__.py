"""Estimates how every place of a frame moves through a window of noisy frames."""
