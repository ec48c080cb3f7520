"""Depth images: estimated by plane sweeps, moved into another camera, and corresponded patch by patch."""
