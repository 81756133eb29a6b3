"""The program that runs a self-test, and puts its verdict where a register table can have it."""

from collections.abc import Sequence
from typing import Final

from coldloop_rig.text_tables import markdown_table

VERDICT: Final = "cl_verdict"
LENGTH: Final = 10
"""Integers that the verdict has room for."""
COMMON: Final = ("done", "passed", "failures", "what", "vector")
"""Outputs of each self-test; two truth values, which are 0 or 1."""


def main_program(outputs: Sequence[str]) -> str:
    """Return the program; `outputs` are those of the self-test beside the common ones, integers."""
    puts = "".join(
        f"    {VERDICT}[{place}] := {f'BOOL_TO_DINT(test.{name})' if name in COMMON[:2] else f'test.{name}'};\n"
        for place, name in enumerate((*COMMON, *outputs))
    )
    return f"""
(* Runs the self-test in a task of its own, and puts its outputs into {VERDICT}. *)
PROGRAM cl_main
VAR_EXTERNAL
    {VERDICT} : cl_dints_{LENGTH};
END_VAR
VAR
    test : cl_self_test;
END_VAR
    test(run := TRUE);
{puts}END_PROGRAM
"""


def verdict_table(outputs: Sequence[str]) -> str:
    """Return what is where in the verdict, for registers of two words each."""
    rows = [
        (f"`{VERDICT}[{place}]`", f"+{2 * place}", f"`test.{name}`") for place, name in enumerate((*COMMON, *outputs))
    ]
    return markdown_table(("integer", "register", ""), rows)
