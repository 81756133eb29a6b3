"""The model file of what a user names as a process."""

from pathlib import Path
from typing import Final

from coldloop.errors import UsageError
from coldloop.kernels.cache_folder import find_cache_folder

LIMIT_S: Final = 300
"""How long a plant may take when its model is made."""


def model_file_of(path: Path, *, in_child: bool = False) -> tuple[Path, list[str]]:
    """Return the model file of a process file or a model file, and warnings; that of a process file is made now.

    Args:
        path: What is named.
        in_child: The plant runs in a process of its own, which ends it when it takes too long.

    Raises:
        ColdloopError: There is no such file, or no model can be made of it.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such file; name a process file or a model file")
    if path.suffix != ".toml":
        return path.resolve(), []

    def work() -> str:
        from coldloop_rig.process_file.judgement import described  # noqa: PLC0415 a model file is read without
        from coldloop_rig.process_file.making import made_from  # noqa: PLC0415

        made = made_from(path)
        out = find_cache_folder("processes") / f"{path.stem}-{made.model.digest[:12]}.json"
        made.model.save(out)
        return f"{out}\n{described(made)}"

    from coldloop_rig.process_file.in_child import text_of_child  # noqa: PLC0415

    said = text_of_child(path, work, LIMIT_S) if in_child else work()
    out, *lines = said.splitlines()
    return Path(out), [line for line in lines if line.startswith("warning")]
