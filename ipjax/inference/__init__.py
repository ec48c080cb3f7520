"""From a frame to an estimate on the host: cropping the frame, running the graph, reporting and drawing the result."""
