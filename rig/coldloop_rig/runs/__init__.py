"""Runs: one into a folder, from the command line or from Python; what repeats it; again from its manifest."""
