"""Captures as people have them on disc, a file a form; `opening` has `open_capture`, which tells the forms apart."""
