"""Modbus/TCP as Coldloop speaks it: a strict server and a typed client over one register map."""
