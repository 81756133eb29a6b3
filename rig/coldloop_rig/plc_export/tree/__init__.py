"""Kernels read from their Python sources into a small typed tree, and what printers of it have in common."""
