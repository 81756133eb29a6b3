"""The tree as C99: the solver, the whole optimiser, and its place on the bus."""
