"""Meshes: reading, cleaning, sampling, writing."""
