"""ipjax: from one photo of an object and one RGB-D image of a scene to the object's metric 6-D pose, in JAX."""

__version__ = "0.1.0"
