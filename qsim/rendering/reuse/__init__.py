"""Lets neighbouring frames share samples: carries them along the motion, chooses by tiles, and states the error."""
