"""Numerical kernels: how they are compiled, cached and loaded."""
