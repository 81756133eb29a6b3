"""The studies of the paper: one for each of its figures and experiments."""
