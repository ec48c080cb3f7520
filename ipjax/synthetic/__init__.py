"""Synthetic objects, scenes, degraded meshes and problems with known answers, for the demo, tests and benchmarks."""
