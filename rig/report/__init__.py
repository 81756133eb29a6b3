"""The report: every claim of the paper beside what was found here, and the verdict."""
