"""Learners examined: subjects, runs, tables, pictures."""
