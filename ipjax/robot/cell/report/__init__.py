"""A pick as a film and as a page."""
