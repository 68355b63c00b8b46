"""The compiled draw: short sums of a sensor, one kernel, and its launches."""
