"""Which experiments to do, and how few can do."""
