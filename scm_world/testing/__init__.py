"""Conformance suites, for whoever adds an engine, a task or a learner."""
