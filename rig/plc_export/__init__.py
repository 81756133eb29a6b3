"""The optimiser's kernels as C99: read from their Python sources, printed, with vectors that prove the same bits."""
