"""Trained agents to compare with: how they were made, and how well they do."""
