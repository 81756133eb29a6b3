"""The optimiser PLC: throttled predictive control with an updating period chosen on line."""
