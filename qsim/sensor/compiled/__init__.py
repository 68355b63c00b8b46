"""Draws codes by compiled kernels: plans of a sensor's cdf steps, one kernel, and its launches."""
