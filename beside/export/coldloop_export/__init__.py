"""The optimiser for a PLC: kernels read from their Python sources, printed as C99 or Structured Text."""
