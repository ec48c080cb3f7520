"""The page of results, made from folders that ``ipjax evaluate`` (or `benchmarks.classical`) wrote.

PAGE.md holds numbers alone; PAGE.html, complete in itself, adds error curves, bars per object, and the best, median and
worst targets of `Config()` drawn over their photos. That page holds photos of the data set: it is kept out of the
repository. `runs` reads, `tables` and `pictures` make what is shown, `page` shows it.
"""
