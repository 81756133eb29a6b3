"""How the programs of a run were connected; its manifest says it."""

from enum import StrEnum


class Way(StrEnum):
    """How the three programs are connected."""

    IN_PROCESS = "in-process"
    LOCALHOST = "localhost"
    ATTACHED = "attached"
    RECORDED = "recorded"
    """Nothing was driven: a session of others was looked at."""
    CHAOS = "chaos"
    """On localhost, with faults on purpose."""
