"""What an operator can ask of a rig: commands, and how they are carried out over its registers."""
