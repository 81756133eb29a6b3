"""The subcommands of `coldloop`, one file each: `add_parser` and `execute`."""
