"""From measured frames to sensor parameters with confidence intervals."""
