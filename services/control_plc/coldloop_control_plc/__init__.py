"""The control PLC: scan cycle, sequence player and guards between the optimiser and the plant."""
