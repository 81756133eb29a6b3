"""What is exported: the solver, the whole optimiser, and recorded runs of both as golden vectors."""
