"""What a rig that is up really runs: the configuration of its services, read from their registers."""

from collections.abc import Mapping
from typing import Any, Final

from coldloop.config import Configuration, load_configuration
from coldloop.errors import LinkError, UsageError
from coldloop.modbus.client import RegisterClient
from coldloop.registers.configuration import ConfigurationDigest, ConfigurationLine, configuration_of, lines_of
from rig.rig_endpoints import RigEndpoints
from rig.session_client import SessionClient
from rig.settings import Settings

OF_SESSION: Final = (
    "session.mode", "session.factor", "plant.load", "plant.seed", "optimizer_plc.program.updating_period_s",
)  # fmt: skip
"""Keys that a rig takes from whoever begins a session."""
OF_CLIENT: Final = ("model.", "rig.")
"""Sections that concern the client. The model of a rig is compared with ours when it is connected to."""
SOURCE: Final = "the rig"


async def read_configuration(client: RegisterClient) -> dict[str, Any]:
    """Return what the registers of a service show of its configuration, by dotted key.

    Raises:
        LinkError: It does not answer, or its text is not whole.
    """
    digest = await client.read(ConfigurationDigest)
    lines = await client.read_rows(ConfigurationLine, 0, lines_of(digest))
    try:
        return configuration_of(digest, lines)
    except ValueError as error:
        raise LinkError(f"{client.peer}: its configuration cannot be read: {error}") from None


async def running_configuration(endpoints: RigEndpoints, settings: Settings, patience_s: float) -> dict[str, Any]:
    """Return what the services of a rig run, by dotted key, without what belongs to a session.

    Raises:
        LinkError: A service does not answer.
        ModelFileError: One runs another model than ours.
        UsageError: Two services run different limits.
    """
    running: dict[str, Any] = {}
    client = SessionClient(endpoints, settings)
    try:
        await client.connect(patience_s)
        for one in client.clients.values():
            shown = await read_configuration(one)
            for key in running.keys() & shown.keys():
                if running[key] != shown[key]:
                    raise UsageError(
                        f"{one.peer} runs {key} = {shown[key]}, another one {running[key]}: give all of them the same"
                    )
            running |= shown
    finally:
        client.close()
    return {key: value for key, value in running.items() if key not in OF_SESSION}


def attached(effective: Configuration[Settings], running: Mapping[str, Any]) -> Configuration[Settings]:
    """Return a configuration with what a rig really runs.

    Args:
        effective: What the user asks for.
        running: What the rig runs.

    Raises:
        UsageError: The user asks for something that the rig does not run, and that a client cannot change.
    """
    asked = {key: value for key, value, _ in effective.effective()}
    for given, source in effective.sources.items():
        covered = [key for key in running if f"{key}.".startswith(f"{given}.")]
        for key in covered:
            if asked.get(key) != running[key]:
                raise UsageError(
                    f"{source}: the rig runs {key} = {running[key]}, which --attach does not change; drop it, or start "
                    "the rig with it"
                )
        if not covered and source.startswith("--") and not given.startswith((*OF_SESSION, *OF_CLIENT)):
            raise UsageError(f"{source}: a rig that is up has its own {given}, which --attach does not change; drop it")
    values = {key: (value, source) for key, value, source in effective.effective() if value is not None}
    values |= {key: (value, SOURCE) for key, value in running.items()}
    return load_configuration(Settings, environment={}, options=values)
