"""The exported optimiser on the bus: its C client and server, with addresses and initial registers."""

import struct
from collections.abc import Mapping
from typing import Any, Final

from coldloop.modbus.endpoints import CONTROL_PORT, OPTIMIZER_PORT
from coldloop.process.declaration import Process
from coldloop.registers.bank import RegisterBank
from coldloop.registers.codec import WordOrder
from coldloop.registers.common import MAGIC, Identity, ServiceState, SessionPace
from coldloop.registers.configuration import publish_configuration
from coldloop.registers.control_plc import (
    Acknowledgement,
    AwaitUpdate,
    Heartbeat,
    LatchedUpdate,
    Plan,
    SequenceHeader,
    SequenceRow,
    Update,
)
from coldloop.registers.declaration import RegisterMap
from coldloop.registers.maps import maps_of
from coldloop.registers.optimizer_plc import (
    HISTORY_ROWS,
    ControlLinkStatus,
    Optimization,
    OptimizerSession,
    UpdatingRuleStatus,
)
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.runtime import HEARTBEAT_TICKS, LOOK_OUT_TICKS
from coldloop_rig.plc_export.c.text import GENERATED
from coldloop_rig.plc_export.kernels.optimizer_program import OptimizerKernels
from coldloop_rig.plc_export.templates import filled, template
from coldloop_rig.plc_export.tree.subset import UnfitKernelError

FILES: Final = ("main.c", "control_plc.c", "control_plc.h", "diagnostics.c", "diagnostics.h", "words.c", "words.h")
Blocks = Mapping[str, tuple[RegisterMap, type[tuple[Any, ...]], str]]
"""Blocks by their names in C, with the types of their values as the C sources put them together."""
RULE_NUMBERS: Final = 5
"""Of the rule of the updating period: those before the times."""


def blocks_of(process: Process) -> Blocks:
    """Return the blocks that the C sources know."""
    _, control, optimizer = maps_of(process)
    values = 2 * len(process.inputs) + len(process.outputs) + len(process.states)
    return {
        "IDENTITY": (control, Identity, "fIHHIIIH"),
        "UPDATE": (control, Update, "IIIIf" + "f" * values + "I"),
        "AWAIT_UPDATE": (control, AwaitUpdate, "III"),
        "PLAN": (control, Plan, "IIffII"),
        "ACKNOWLEDGEMENT": (control, Acknowledgement, "IHI"),
        "HEARTBEAT": (control, Heartbeat, "HIII"),
        "LATCHED_UPDATE": (control, LatchedUpdate, "IIII"),
        "SEQUENCE_HEADER": (control, SequenceHeader, "IIIHHII"),
        "SEQUENCE": (control, SequenceRow, "f" * len(process.inputs)),
        "OPTIMIZER_IDENTITY": (optimizer, Identity, "fIHHIIIH"),
        "SESSION": (optimizer, OptimizerSession, "IHfH"),
        "CONTROL_LINK": (optimizer, ControlLinkStatus, "HIIIII"),
        "PACE": (optimizer, SessionPace, "IHfH"),
        "UPDATING_RULE": (optimizer, UpdatingRuleStatus, "HHHHHfff"),
        "HISTORY": (optimizer, Optimization, "IIHHHH" + "f" * 11),
    }


def bus_files(
    optimizer: OptimizerProgram, kernels: OptimizerKernels, order: WordOrder, configuration: Mapping[str, Any]
) -> dict[str, str]:  # fmt: skip
    """Return the texts of the files by their names.

    Args:
        optimizer: The program that is exported.
        kernels: What is exported of it.
        order: Word order of the optimiser's own registers.
        configuration: What these show of it.
    """
    texts = {f"bus/{name}": filled(template(f"c/optimizer/bus/{name}"), {"GENERATED": GENERATED.rstrip()})
             for name in FILES}  # fmt: skip
    return {**texts, "bus/registers.h": _header(optimizer, kernels, order, configuration)}


def _header(
    optimizer: OptimizerProgram, kernels: OptimizerKernels, order: WordOrder, configuration: Mapping[str, Any]
) -> str:  # fmt: skip
    process, blocks = optimizer.process, blocks_of(optimizer.process)
    times = {name: getattr(optimizer.budget.times, name) for name in ("slots", "preparation", "iteration")}
    statuses = [rule.status._replace(**times) for rule in kernels.rules]
    image = _image(optimizer, statuses[0], order, configuration)
    words = struct.unpack(f">{len(image) // 2}H", image)
    listed = "".join(f"    {{{address}, {word}}},\n" for address, word in enumerate(words) if word)
    rules = "".join(f"    {{{', '.join(str(int(each)) for each in status[:RULE_NUMBERS])}}},\n" for status in statuses)
    names = {
        "CONTROL_PORT": CONTROL_PORT, "OPTIMIZER_PORT": OPTIMIZER_PORT, "HISTORY_ROWS": HISTORY_ROWS,
        "IDENTITY_MODEL": 6, "SEQUENCE_ROW_WORDS": 2 * len(process.inputs), "RULE_NUMBERS": RULE_NUMBERS,
        "MODEL_DIGEST": f"UINT32_C({optimizer.model_digest})", "MAGIC": f"{MAGIC!r}F",
        "SEQUENCE_ROW_LETTERS": f'"{blocks["SEQUENCE"][2]}"',
        "USUAL_PERIOD": round(optimizer.settings.updating_period_s / process.tick_s),
        "OPTIMIZER_LOW_FIRST": str(order is WordOrder.LOW_FIRST).lower(),
        "PREPARATION_S": repr(float(times["preparation"])), "ITERATION_S": repr(float(times["iteration"])),
        "LOOK_OUT_S": repr(LOOK_OUT_TICKS * process.tick_s), "HEARTBEAT_S": repr(HEARTBEAT_TICKS * process.tick_s),
    }  # fmt: skip
    defined = "".join(f"#define {name} {value}\n" for name, value in names.items())
    return f"""{GENERATED}#ifndef REGISTERS_H
#define REGISTERS_H

#include <stdbool.h>
#include <stdint.h>

{defined}
{_addresses(blocks)}
/* The rule that each fixed updating period in ticks has, 0 is adaptive: its kind and its numbers. */
static const uint16_t rule_status[{len(statuses)}][RULE_NUMBERS] = {{
{rules}}};

/* The registers of the optimiser at the start, those that are not 0: address and value. */
static const uint16_t image[][2] = {{
{listed}}};

#endif
"""


def _addresses(blocks: Blocks) -> str:
    lines = []
    for name, (of, record, letters) in blocks.items():
        block = of.block_of(record)
        if block.letters != letters:
            raise UnfitKernelError(f"block {block.name} has the values {block.letters}, its C source {letters}")
        lines.append(f"#define {name} {block.address}\n#define {name}_WORDS {block.row_words}\n"
                     f'#define {name}_LETTERS "{letters}"\n')  # fmt: skip
    return "".join(lines)


def _image(
    optimizer: OptimizerProgram, rule: UpdatingRuleStatus, order: WordOrder, configuration: Mapping[str, Any]
) -> bytes:  # fmt: skip
    """Return all registers of an optimiser that has just been started."""
    registers = maps_of(optimizer.process).optimizer_plc
    bank = RegisterBank(registers, order)
    bank.put(Identity(map_digest=registers.digest, map_version=registers.version, state=ServiceState.READY,
                      model_digest=optimizer.model_digest))  # fmt: skip
    bank.put(optimizer.operating_limits)
    bank.put(rule)
    publish_configuration(bank, configuration)
    return bank.read(0, registers.end)
