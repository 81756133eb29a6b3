"""Modbus/TCP as Coldloop speaks it: a strict server and a typed client over one register map."""

import logging

logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # what it would say is raised by our client
