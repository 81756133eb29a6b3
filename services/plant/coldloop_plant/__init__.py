"""The plant: the cold part of a 450 W at 4.4 K helium refrigerator, simulated."""
