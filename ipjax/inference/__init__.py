"""One frame in, one answer out: cutting the frame, running the graph, telling and drawing what it found."""
