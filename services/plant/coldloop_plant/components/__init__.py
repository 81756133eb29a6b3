"""The parts of a helium refrigerator: each module holds one part, its parameters and its physics."""
