"""Long jobs: folders with finished cells, and the processes or the cluster that make the rest."""
