"""Where frames come from: data sets, archives and folders, each with the names of its frames and a reader for one."""
