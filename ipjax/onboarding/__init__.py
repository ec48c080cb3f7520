"""From a mesh or a photo to an object that can be found."""
