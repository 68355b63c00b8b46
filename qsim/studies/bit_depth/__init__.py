"""Which bit depth is best at which motion and light."""
