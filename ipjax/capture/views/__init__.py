"""New views: of a captured scene from where no camera stood, and of its models in new arrangements."""
