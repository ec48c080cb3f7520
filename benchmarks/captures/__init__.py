"""How good each step from a capture to a data set is, on made captures, whose truth is known, and on real ones.

A module a step: `measure` makes rows, `tell` makes the lines of its tables. `__main__` runs them and writes the page.
"""
