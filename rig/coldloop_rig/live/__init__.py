"""Rigs that stay up on this machine: started, found, ended, shown on the operator's page."""
