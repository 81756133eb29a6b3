"""Somebody's package as it is installed: modules with entry points."""

from collections.abc import Mapping
from pathlib import Path


def installed(site: Path, sources: Mapping[str, str], points: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """Write modules and entry points as they are in an installed package; return the variables that find it."""
    about = site / "outside-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: outside\nVersion: 1.0\n", encoding="utf-8")
    lines = (
        line for group, named in points.items() for line in (f"[{group}]", *(f"{a} = {b}" for a, b in named.items()))
    )
    (about / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")
    for name, source in sources.items():
        (site / name).write_text(source, encoding="utf-8")
    return {"PYTHONPATH": str(site)}
