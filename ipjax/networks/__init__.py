"""The networks, in Flax: arrays in, arrays out, and weights by name."""
