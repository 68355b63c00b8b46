"""Parts of one's own: two sensors, a method and a scene."""
