"""Provides operators that several networks share, in plain torch; they have no weights."""
