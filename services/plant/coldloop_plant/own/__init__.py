"""Plants that are not the cold box: a user's Python class, transfer functions with dead times, a linear model."""
