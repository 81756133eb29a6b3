"""Co-simulation: drives the three programs in one process, or the services over the bus, for the sessions of a run."""
