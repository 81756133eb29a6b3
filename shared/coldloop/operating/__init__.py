"""Operations on a rig: an operator's commands, and how they are carried out over its registers."""
