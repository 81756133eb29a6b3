"""Plans of a stand-alone proxy: TOML files with the faults of its link and their times."""

from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from coldloop_rig.chaos.faults import AnyLinkFault, Link, LinkFault

DAY_S = 86_400.0


class FaultTransition(NamedTuple):
    """A fault begins or ends."""

    at_s: float
    """Real time since the proxy has started."""
    begins: bool
    fault: LinkFault


class LinkPlan(BaseModel):
    """Faults of one link. Instants are real time, from the start of the proxy."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    """Decides which frames are hit."""
    faults: Annotated[tuple[AnyLinkFault, ...], Field(min_length=1)]
    """As in a chaos plan, with no `link`. Without `at_s` they begin at once, without `duration_s` they last a day."""

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, content: Any) -> Any:  # noqa: ANN401 what a file holds
        if not isinstance(content, dict) or not isinstance(content.get("faults"), list):
            return content
        if "load" in content:
            raise ValueError(
                "this is a chaos plan; a proxy's plan has only `seed` and `faults` (`coldloop docs chaos`)"
            )
        return {**content, "faults": [_completed(fault) for fault in content["faults"]]}

    def changes(self) -> list[FaultTransition]:
        """Return when faults begin and end, in the order of time."""
        changes = []
        for fault in self.faults:
            begin_s = fault.at_s or 0.0
            changes.append(FaultTransition(begin_s, begins=True, fault=fault))
            changes.append(FaultTransition(begin_s + fault.duration_s, begins=False, fault=fault))
        return sorted(changes, key=lambda change: change.at_s)


def _completed(fault: object) -> object:
    if not isinstance(fault, dict):
        return fault
    if "link" in fault:
        raise ValueError("faults: a proxy has one link; leave `link` out")
    return {"at_s": 0.0, "duration_s": DAY_S, "link": Link.PLANT, **fault}
