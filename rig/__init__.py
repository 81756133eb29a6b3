"""The rig: the three programs put together, in one process or as three, recorded, plotted and studied."""
