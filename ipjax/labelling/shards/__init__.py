"""Shards of a source: planned alike by every worker, labelled one by one, resumed where a worker was killed."""
