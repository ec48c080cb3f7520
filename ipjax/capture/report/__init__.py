"""The report of a run: one page that shows every step."""
