"""The compiled draw: plans of a sensor's cdf steps, one kernel, and its launches."""
