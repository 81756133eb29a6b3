"""Shared parts of the tests beside fixtures: programs as processes, and waiting for a condition."""
