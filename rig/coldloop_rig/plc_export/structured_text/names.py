"""Names that Structured Text takes: within 32 characters, no keyword, no two that differ in capitals only."""

import re
import zlib
from typing import Final

LONGEST: Final = 32
"""Characters of a name that every tool tells apart."""
PREFIX: Final = "cl_"
"""Of all that is global: types, functions, function blocks and constants."""
KEYWORDS: Final = """
    abs acos action add add_time and and_then andn any any_bit any_num array asin at atan atan2 bool by byte cal
    calc calcn case char class concat configuration constant continue cos ct ctd ctu ctud d date date_and_time
    delete dint div do ds dt dword else elsif end end_action end_case end_class end_configuration end_for
    end_function end_function_block end_if end_interface end_method end_namespace end_program end_repeat
    end_resource end_step end_struct end_transition end_type end_var end_while eq exit exp expt extends f_edge
    f_trig false final find for from function function_block ge goto gt if implements in initial_step insert int
    interface internal interval inv jmp jmpc jmpcn l ld ldate ldt ldn le left len limit lint ln log lower_bound
    lreal lt ltime ltod lword max method mid min mod move mul mux n namespace ne non_retain not null of on or
    or_else orn overlap override p priority private program protected public r r1 r_edge r_trig read_only read_write
    ref ref_to real repeat replace resource ret retain retc retcn return right rol ror rs s s1 sd sel semaphore shl
    shr sin single sint sl sqrt sr st step stn string struct sub super t tan task then this time time_of_day to tod
    tof ton tp transition true trunc type udint uint ulint until upper_bound using usint var var_access var_config
    var_external var_global var_in_out var_input var_output var_temp wchar while with word wstring xor xorn
"""


def identifier(name: str) -> str:
    """Return a name with its letters and digits, changed where it is a keyword or too long."""
    plain = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9]", "_", name)).strip("_") or "unused"
    plain = f"{plain}_v" if re.search(rf"\b{plain.lower()}\b", KEYWORDS) else plain
    if len(plain) <= LONGEST:
        return plain
    return f"{plain[: LONGEST - 9].rstrip('_')}_{zlib.crc32(plain.encode()):08x}"


class Names:
    """Names within one function block, which are case-insensitive; each key has one."""

    def __init__(self) -> None:
        self._of: dict[object, str] = {}
        self._taken: set[str] = set()

    def __call__(self, key: object, wanted: str) -> str:
        """Return the name of a key; at first the one that is wanted, or it with a number."""
        if key not in self._of:
            plain = identifier(wanted)
            found, number = plain, 2
            while found.lower() in self._taken:
                found, number = identifier(f"{plain}_{number}"), number + 1
            self._of[key] = found
            self._taken.add(found.lower())
        return self._of[key]
