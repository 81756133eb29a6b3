"""Helium properties for the plant: tables made off line, and the kernels that read them."""
