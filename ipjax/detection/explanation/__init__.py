"""What was sought in a frame without masks, and why it was found or not: drawn (`pictures`) and shown (`page`)."""
