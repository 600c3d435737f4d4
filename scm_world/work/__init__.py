"""Work in processes of its own, with one thread each."""
