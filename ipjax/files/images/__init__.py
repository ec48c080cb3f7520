"""Images of a sensor: colour, depth and masks."""
