"""Conformance suites, for custom engines, tasks and learners."""
