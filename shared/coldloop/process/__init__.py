"""The process across the link: its signals and their units, the limits of its actuators, its linear model."""
