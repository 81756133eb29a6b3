"""Parts of every service besides its program: its start, journal, logs, metrics and telemetry."""
