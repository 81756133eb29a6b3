"""Traces on record: what runs of one process leave behind, as `tests/traces.json` has it (`scripts/traces`)."""
