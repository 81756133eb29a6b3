"""Register maps: each register is declared once, everything else is derived from the declaration."""
