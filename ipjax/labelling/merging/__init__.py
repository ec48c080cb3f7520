"""All shards as one data set, and a page that says how good the labels are and which frames to look at."""
