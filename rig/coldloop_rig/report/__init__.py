"""The report: every claim of the paper with our result and the verdict."""
