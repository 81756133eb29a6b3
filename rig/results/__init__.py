"""Results of a run: recorded as it goes on, evaluated, kept in a folder, read again, compared, exported."""
