"""The one-process rig's ordinary ticks as compiled loops; whatever is unusual is left to the programs."""
