"""Made objects, scenes and damage: what the demo, the tests and the benchmarks are fed."""
