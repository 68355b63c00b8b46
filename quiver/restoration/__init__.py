"""Restores clips of any size with any method, in bounded memory."""
