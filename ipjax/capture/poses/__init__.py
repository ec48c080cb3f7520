"""Where the camera stood: features and their tracks, structure from motion, metric scale, poses given, boards."""
