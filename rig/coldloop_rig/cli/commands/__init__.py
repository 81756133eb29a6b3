"""The subcommands of `coldloop`, one file each: `declare` and `execute`."""
