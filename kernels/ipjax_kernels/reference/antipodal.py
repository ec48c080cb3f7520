"""The obvious NumPy loop for `ipjax_kernels.antipodal`: the oracle of the tests."""

import numpy as np


def find_opposite(points, normals, start, axis, reach, aside, facing):
    """One ray after another, one point after another."""
    nearest, farthest = np.full(len(start), np.inf), np.full(len(start), -np.inf)
    for a, (origin, direction) in enumerate(zip(start, axis, strict=True)):
        for point, normal in zip(points, normals, strict=True):
            along = (point - origin) @ direction
            away = np.linalg.norm(point - origin - along * direction)
            if reach[0] < along < reach[1] and away < aside and normal @ direction > facing:
                nearest[a], farthest[a] = min(nearest[a], along), max(farthest[a], along)
    return nearest, farthest


def smooth_normals(points, normals, chosen, own, radius, alike):
    """One chosen point after another."""
    smooth = []
    for point, normal in zip(chosen, own, strict=True):
        near = (np.linalg.norm(points - point, axis=-1) < radius) & (normals @ normal > alike)
        total = normals[near].sum(0) + 1e-6 * normal
        smooth.append(total / np.linalg.norm(total))
    return np.array(smooth)
