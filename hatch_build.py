"""Puts pages and examples into the wheel, for `coldloop docs` and `coldloop new`; an image of a service has none."""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Pages(BuildHookInterface):  # type: ignore[type-arg]
    """The hook of `[tool.hatch.build.targets.wheel.hooks.custom]`."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the pages, but to an editable installation, which reads them where they are."""
        if version != "editable":
            pages, examples = Path(self.root, "docs").glob("*.md"), Path(self.root, "examples")
            build_data["force_include"].update({str(page): f"coldloop_rig/pages/{page.name}" for page in pages})
            build_data["force_include"].update({
                str(file): f"coldloop_rig/examples/{file.relative_to(examples)}"
                for file in examples.rglob("*.*") if file.is_file() and file.suffix != ".pyc"
            })  # fmt: skip
