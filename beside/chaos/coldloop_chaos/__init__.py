"""Fault injection: chaos plans, their proxies and processes, and the evaluation."""
