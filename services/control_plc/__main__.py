"""`python -m control_plc`: the control PLC as a service."""

import sys

from coldloop.service.start import main
from control_plc.runtime import serve
from control_plc.settings import ControlSettings

if __name__ == "__main__":
    sys.exit(main("control_plc", ControlSettings, serve, None))
