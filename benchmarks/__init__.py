"""Benchmarks: see `python -m benchmarks.step --help` for the cost of a step."""
