"""Labelling many frames: a pure function of batches, and shards of a source that are labelled, resumed and merged."""
