"""Configuration of the operator's page, checked when it is made and immutable after."""

from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, Field, PositiveFloat, model_validator

from coldloop.modbus.settings import CONTROL_PORT, OPTIMIZER_PORT, PLANT_PORT, Endpoint, TlsSettings
from coldloop.process.settings import RootSettings

PAGE_PORT = 8020
PortNumber = Annotated[int, Field(ge=1, le=0xFFFF)]
TIMEOUT_S = 1.0
"""A server that does not answer within this time is shown as silent: values are crossed out within 2 s."""


class PolledPlant(Endpoint):
    """Address of the plant."""

    port: PortNumber = PLANT_PORT
    """TCP port."""
    timeout_s: PositiveFloat = TIMEOUT_S


class PolledControl(Endpoint):
    """Address of the control PLC."""

    port: PortNumber = CONTROL_PORT
    """TCP port."""
    timeout_s: PositiveFloat = TIMEOUT_S


class PolledOptimizer(Endpoint):
    """Address of the optimiser PLC."""

    port: PortNumber = OPTIMIZER_PORT
    """TCP port."""
    timeout_s: PositiveFloat = TIMEOUT_S


class HttpsSettings(BaseModel, frozen=True, extra="forbid"):
    """Files for HTTPS, PEM."""

    certificate: Path
    """Certificate, and those that lead to an authority."""
    key: Path
    """Its key."""


class LoginSettings(BaseModel, frozen=True, extra="forbid"):
    """Who may do what.

    Args:
        users: File with a line `name:role:hash` for each user; `python -m coldloop_hmi.users` writes it. None: no
            operators.
        anonymous_view: Everybody who reaches the page may look at it; only commands need a login.
        idle_minutes: A session without a request for so long ends.
        longest_minutes: Every session ends after this time.
    """

    users: Path | None = None
    anonymous_view: bool = True
    idle_minutes: PositiveFloat = 30.0
    longest_minutes: PositiveFloat = 600.0


class HmiSection(BaseModel, frozen=True, extra="forbid"):
    """Section `hmi` of the configuration.

    Args:
        host: Address that the page listens on; others than this machine's need HTTPS or `insecure`.
        port: TCP port; 0 takes any free one.
        https: Files for HTTPS.
        insecure: Serve other machines without HTTPS: passwords cross the network readable.
        allowed_hosts: Names that browsers may call the page by, besides localhost and `host`.
        plant: Where the plant is; its `tls` is a certificate of a reader.
        control_plc: Where the control PLC is.
        optimizer_plc: Where the optimiser PLC is.
        operator_tls: Certificate with the operator's role, used only to carry out a command.
        login: Who may do what.
        audit: File that every command, login and refusal is appended to, a JSON object a line.
        poll_s: Time between two looks at the process.
        kept_s: How much of the trends is kept, s of plant time.
        training: Offer the sensor faults of the plant as a panel.
        browsers: Most streams to browsers at a time; a user who has logged in takes the place of a stranger.
        connections: Most connections at a time; one that waits gives way to a new one. With all else that is open,
            fewer than the system's limit of open files.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=0xFFFF)] = PAGE_PORT
    https: HttpsSettings | None = None
    insecure: bool = False
    allowed_hosts: tuple[str, ...] = ()
    plant: PolledPlant = PolledPlant()
    control_plc: PolledControl = PolledControl()
    optimizer_plc: PolledOptimizer = PolledOptimizer()
    operator_tls: TlsSettings | None = None
    login: LoginSettings = LoginSettings()
    audit: Path | None = None
    poll_s: Annotated[float, Field(ge=0.02, le=5)] = 0.125
    kept_s: Annotated[float, Field(ge=300, le=86_400)] = 7200.0
    training: bool = False
    browsers: Annotated[int, Field(ge=1, le=1000)] = 64
    connections: Annotated[int, Field(ge=16, le=10_000)] = 400

    @property
    def is_local(self) -> bool:
        """Whether only this machine reaches the page."""
        try:
            return self.host == "localhost" or ip_address(self.host).is_loopback
        except ValueError:
            return False

    @model_validator(mode="after")
    def _passwords_are_not_readable(self) -> Self:
        if not self.is_local and self.https is None and not self.insecure:
            raise ValueError(
                f"host {self.host} is reached from other machines: "
                "give https.certificate and https.key, or insecure = true"
            )
        return self


class HmiSettings(RootSettings):
    """Settings that the page reads of a configuration: the model file says of which process the rig is."""

    hmi: HmiSection = HmiSection()
