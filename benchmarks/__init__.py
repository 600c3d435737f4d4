"""Scripts that measure the package; see docs/benchmarks."""
