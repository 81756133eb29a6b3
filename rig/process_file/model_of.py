"""The model file of what a user names as a process."""

from pathlib import Path


def model_file_of(path: Path) -> Path:
    """Return the model file of a process file or a model file."""
    return path
