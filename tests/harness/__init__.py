"""What tests of several folders share, and what is no fixture: programs as processes, and waiting for a condition."""
