"""Depth of a capture, in the pixels of its colours: estimated, aligned, fused."""
