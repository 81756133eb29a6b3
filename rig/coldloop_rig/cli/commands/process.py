"""`coldloop process`: a process file checked, linearised and judged, and made into the model file of all programs."""

import argparse
import sys
from pathlib import Path

from coldloop_rig.cli.commands.options import positive_count
from coldloop_rig.terminal import fitted, width


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("file", type="read", nargs="?", metavar="FILE", help="process file (TOML)")
    what.add_argument("--keys", action="store_true", help="list the keys of process files, as Markdown")
    parser.add_argument("--out", type="write", metavar="MODEL",
                        help="write the model file; then --process MODEL, or the key model.file")  # fmt: skip
    parser.add_argument("--limit", type=positive_count, default=300, metavar="SECONDS",
                        help="how long its plant may take, in a process of its own (default: 300)")  # fmt: skip


def execute(options: argparse.Namespace) -> int:
    """Make, print; write the model file when there is --out."""
    from coldloop.errors import UsageError
    from coldloop.process.declaration import Process
    from coldloop.whole_file import require_regular_file
    from coldloop_rig.cli.key_listing import key_listing
    from coldloop_rig.process_file.judgement import described
    from coldloop_rig.process_file.making import made_from
    from coldloop_rig.process_file.reading import text_of_child

    out: Path | None = options.out
    if options.keys:
        if out is not None:
            raise UsageError("--out: writes the model of a process file; name that file, and leave out --keys")
        sys.stdout.write(key_listing(Process))
        return 0
    if out is not None:
        require_regular_file(out)
        if out.resolve() == options.file.resolve():
            raise UsageError(f"{out}: is the process file; name another one with --out")

    def work() -> str:
        made = made_from(options.file)
        if out is None:
            return described(made)
        try:
            made.model.save(out)
        except OSError as error:
            raise UsageError(f"{out}: {error.strerror}; name a file that can be written with --out") from None
        return f"{described(made)}written to {out}\n"

    sys.stdout.write(fitted(text_of_child(options.file, work, options.limit), width()))
    return 0
