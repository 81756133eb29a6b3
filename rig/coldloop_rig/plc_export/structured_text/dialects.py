"""Text that differing tools read alike."""

import re
from typing import Final

_FOR: Final = re.compile(r"( *)FOR (\w+) := (.+) TO (.+?)(?: BY (-?\d+))? DO")


def portable(text: str) -> str:
    """Return Structured Text with a WHILE for each FOR that may have a single round: newer MATIEC leaves that one out.

    Bounds do not change within a loop of this package.
    """
    lines, steps = [], list[str]()
    for line in text.split("\n"):
        if found := _FOR.fullmatch(line):
            pad, name, first, last, by = found.groups()
            step = int(by or 1)
            if first.isdigit() and last.isdigit() and (int(last) - int(first)) // step > 0:
                steps.append("")
                lines.append(line)
                continue
            steps.append(f"{pad}    {name} := ({name} {'+' if step > 0 else '-'} {abs(step)});\n{pad}END_WHILE;")
            lines += [f"{pad}{name} := {first};", f"{pad}WHILE ({name} {'<=' if step > 0 else '>='} {last}) DO"]
        else:
            lines.append((line.strip() == "END_FOR;" and steps.pop()) or line)
    return "\n".join(lines)
