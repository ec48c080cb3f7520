"""From a capture of a scene to a data set: reading it, camera poses, depth, models, labels, new views."""
