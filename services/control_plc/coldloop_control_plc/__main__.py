"""`python -m coldloop_control_plc`: the control PLC as a service."""

import sys

from coldloop.service.start import main
from coldloop_control_plc.runtime import serve
from coldloop_control_plc.settings import ControlSettings

if __name__ == "__main__":
    sys.exit(main("control_plc", ControlSettings, serve, None))
