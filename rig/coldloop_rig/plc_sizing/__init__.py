"""Sizing of PLCs: speed and memory of the reference PLC, operations counted, budgets, certified iterations."""
