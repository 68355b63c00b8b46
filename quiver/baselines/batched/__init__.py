"""Restores batches of frames by the classical methods where their codes are, on any device: nothing waits for the host.

The methods beside this package (methods.py) state what is computed, and run on a CPU, where their order of work is
faster. What is computed here differs from them by rounding.
"""
