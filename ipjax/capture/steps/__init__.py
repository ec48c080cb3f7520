"""The steps from a capture to a data set, one after the other, each made again only where it has to be."""
