"""What every service is besides its program: its start, journal, logs, metrics and telemetry."""
