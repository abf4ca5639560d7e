"""What fits cost, how close they come, and what others take for the same work: `python -m benchmarks`."""
