"""What keeps the plant safe when a peer, a writer or a disk fails: watchdog, leases, sequences, retained states."""
