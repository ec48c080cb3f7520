"""Arrays in, arrays out: the numerical kernels of ipjax. Imports jax and jaxtyping only."""
