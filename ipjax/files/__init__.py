"""What comes from disk or goes there."""
