"""Storage: budgets of memory, JSON and YAML, files that appear whole, locks between processes, the cache folder."""
