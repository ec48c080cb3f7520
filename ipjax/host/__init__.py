"""What cannot be jitted: files, meshes, rendering, weights, data sets."""
