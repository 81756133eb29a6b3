"""The cold box: its physics, operating point and linear model."""
