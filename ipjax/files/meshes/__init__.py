"""Meshes, whoever made them: reading, cleaning, sampling, writing."""
