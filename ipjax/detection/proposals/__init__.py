"""Masks that may be of an object, from one RGB-D image and nothing else: no object is known here, and no network runs.

The image is cut into segments (`segments`), which trees join in several ways (`trees`); large planes are found
(`planes`), and what stands off them is cut at jumps of depth (`components`), or into balls of a known size (`windows`).
All masks are judged by their border (`objectness`), and the best of those that differ are kept (`propose`).
"""
