"""Executors: jobs in this process, in others, or on Ray."""
