"""Safety of the plant when a peer, a writer or a disk fails: watchdog, leases, sequences, retained states."""
