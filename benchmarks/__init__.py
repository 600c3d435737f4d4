"""Scripts that measure the package; see README.md."""
