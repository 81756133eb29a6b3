"""What the head of a run says of its configuration."""

from coldloop.config import Configuration
from rig.settings import Settings


def remarks(effective: Configuration[Settings]) -> list[str]:
    """Return what a user should know before a run, a line each; usually nothing."""
    left_out = effective.notes()
    if not left_out:
        return []
    return [f"not applied of the preset: {', '.join(left_out)}; `coldloop config` says why"]
