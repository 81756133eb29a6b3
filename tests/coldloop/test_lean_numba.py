"""numba is loaded without the packages that it takes along, and these can be had afterwards."""

from tests.harness.processes import Processes


def test_what_was_hidden_from_numba_can_be_imported_afterwards(processes: Processes) -> None:
    program = (
        "import sys\n"
        "from coldloop.kernels.cache import TAKEN_ALONG, load_numba_alone\n"
        "load_numba_alone()\n"
        "assert 'numba' in sys.modules and not {*TAKEN_ALONG} & sys.modules.keys()\n"
        "import scipy.linalg, cffi\n"
        "assert scipy.linalg.norm([3.0, 4.0]) == 5.0\n"
        "import numba, numpy\n"
        "print(numba.njit(lambda A: A @ A)(2.0 * numpy.eye(2))[0, 0])\n"
    )
    out, _ = processes.run_python(program)
    assert out.split() == ["4.0"]


def test_what_was_loaded_before_stays(processes: Processes) -> None:
    program = (
        "import sys, scipy\n"
        "from coldloop.kernels.cache import load_numba_alone\n"
        "load_numba_alone()\n"
        "assert sys.modules['scipy'] is scipy\n"
    )
    processes.run_python(program)
