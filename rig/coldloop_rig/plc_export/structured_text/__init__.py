"""The tree as Structured Text and PLCopen XML."""
