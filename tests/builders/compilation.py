"""How tests compile the large graphs that they run a few times."""

# LLVM's optimisation takes two thirds of the compilation, and saves half of a run. Not for derivatives and not where an
# answer hangs on the last digit: without it numbers are rounded otherwise. `test_pipeline` compares the answers.
QUICKLY = {"xla_backend_optimization_level": 0}
