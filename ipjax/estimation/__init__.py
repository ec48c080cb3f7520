"""The graph: from described patches to a pose, a stage a file, and nothing that cannot be jitted."""
