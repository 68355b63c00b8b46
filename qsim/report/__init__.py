"""Results on disk as pages and previews. Nothing is computed here that is not in the files."""
