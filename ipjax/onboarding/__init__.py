"""From a mesh or a photo to templates of an object, and a report on them."""
