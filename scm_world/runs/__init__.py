"""Long jobs: folders that hold what is done, and the processes or the cluster that do the rest."""
