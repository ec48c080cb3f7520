"""Made objects, scenes, damage and problems with known answers: what the demo, the tests and benchmarks are fed."""
