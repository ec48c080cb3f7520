"""Data sets in BOP's layout: reading, estimating, scoring."""
