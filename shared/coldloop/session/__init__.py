"""A session: one run of the rig from tick 0, and its time base."""
