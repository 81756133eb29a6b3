"""Faults on purpose: chaos plans, the proxies and processes they act on, and what came of them."""
