"""The one-process rig's ordinary ticks as compiled loops; all other ticks are left to the programs."""
