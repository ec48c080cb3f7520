"""Where the camera stood, made exact: depth images and colours of all frames brought to agree."""
