"""Poses of objects that one photo without depth showed: through the camera of the photo."""
