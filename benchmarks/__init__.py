"""Benchmarks: ``python -m benchmarks`` measures, ``python -m benchmarks.table`` turns results into Markdown."""
