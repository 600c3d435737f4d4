"""What the package costs: ``python -m benchmarks.speed``."""
