"""Results of a run: recorded, evaluated, kept in a folder, read again, compared, exported."""
