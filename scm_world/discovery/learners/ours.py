"""Our own learners."""
