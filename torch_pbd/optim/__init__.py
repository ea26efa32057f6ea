"""L-BFGS that keeps its best point, for one objective or many small ones in parallel, and Fisher scoring."""
