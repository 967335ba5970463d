"""What a step costs: see `python -m benchmarks.step --help`."""
