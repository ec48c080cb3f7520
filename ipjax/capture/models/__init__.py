"""Models of what a capture shows: depth of all frames in one volume, its surface, and what BOP tells of a model."""
