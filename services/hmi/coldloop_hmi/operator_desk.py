"""Commands of users, and their logins: two steps, the operator's role only meanwhile, and a read-back.

A command is confirmed against its premises: what it would change, read from the registers, as others may change it.
"""

import asyncio
import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from aiohttp import web

from coldloop.errors import LinkError, UsageError
from coldloop.modbus.settings import Endpoint
from coldloop.operating import commands, execution
from coldloop.registers import common, control_plc, plant
from coldloop.text import parsed_json, value_text
from coldloop_hmi import documents, process_image
from coldloop_hmi.guard import Guard, compressed_answer, cookie_name, refusal
from coldloop_hmi.settings import HmiSection
from coldloop_hmi.users import Audit, Users

Premises = dict[str, str]
"""Present values by what they are of, in words."""
CONFIRM_WITHIN_S: Final = 60.0
MOST_PREPARED: Final = 100
TIMEOUT_S: Final = 3.0
LONGEST_REQUEST: Final = 2_000_000
"""Bytes of a request: a load file fits."""


async def read_premises(clients: execution.Clients, command: commands.Command) -> Premises:
    """Read the premises of a command: of all the session, of one about an alarm or a sensor no more than that.

    Raises:
        LinkError: A service does not answer.
        UsageError: A setpoint, and another mode than manual.
    """
    found = {"session": str((await next(iter(clients.values())).read(common.Identity)).session)}
    match command:
        case commands.SetMode():
            mode = (await clients["control_plc"].read(control_plc.LadderStatus)).mode
            found["operator's mode"] = control_plc.OperatorMode.word_of(
                (await clients["control_plc"].read(control_plc.Operator)).mode
            )
            found["active"] = control_plc.Mode.word_of(
                control_plc.Mode.MPC if mode == control_plc.Mode.REST else mode
            )  # between two sequences
        case commands.SetSetpoint():
            operator = await execution.check_manual(clients["control_plc"])
            found[f"setpoint of {command.input}"] = value_text(operator.u[command.place], command.unit)
        case commands.SetLoad() | commands.PlayLoad():
            load, process = await clients["plant"].read(plant.LoadStatus), command.process
            until = f"changing until {commands.clock_text(load.last_tick * process.tick_s)}"  # by itself
            found[process.load.title] = until if load.upcoming else value_text(load.watts, process.load.unit)
        case commands.SetFactor() | commands.SetPaused():
            pace = await clients["plant"].read(common.SessionPace)
            running = f"{'paused, ' if pace.paused else ''}factor {value_text(pace.factor)}"
            found["plant time"] = running if pace.realtime else "lock-step"
    return found


def differences(before: Premises, now: Premises) -> str:
    """Return what has changed, in words; empty if nothing has."""
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    return "; ".join(f"{name}: {before.get(name, 'not known')}, now {now.get(name, 'not known')}" for name in names)


class Preview(NamedTuple):
    """Preview of a command: what it would do, what it would change as it is now, and the token that confirms it."""

    token: str
    text: str
    now: str


class Prepared(NamedTuple):
    """A command that waits for its confirmation."""

    command: commands.Command
    text: str
    user: str
    until: float
    premises: Premises


class PremisesChangedError(UsageError):
    """The state that a command was prepared for has changed since."""

    def __init__(self, reason: str, preview: Preview) -> None:
        super().__init__(reason)
        self.preview = preview


class CommandResult(NamedTuple):
    """Result of a command: one of the last three fields says it."""

    asked: str
    applied: str = ""
    """Value that was read back."""
    refused_because: str = ""
    """It was not done, and why."""
    uncertain_because: str = ""
    """It was written, and it is not known what has become of it, or only a part was done."""


class OperatorDesk:
    """Takes commands and carries them out at endpoints by service, which have the operator's certificate.

    `model` is what is known of the rig, `now` a monotonic clock, s; sensor faults are for `training`.
    """

    def __init__(
        self, endpoints: dict[str, Endpoint], model: process_image.Model, now: Callable[[], float], *, training: bool
    ) -> None:
        self._endpoints = endpoints
        self._model = model
        self.process = model.process
        self._now = now
        self._training = training
        self._prepared: OrderedDict[str, Prepared] = OrderedDict()
        self._turn = asyncio.Lock()
        self._last = ""  # whose the last command was, and what

    async def prepare(self, command: commands.Command, user: str) -> Preview:
        """Take a command, and return what it would do, with the token that confirms it.

        Raises:
            UsageError: It is not possible now.
            LinkError: The service does not answer.
        """
        if isinstance(command, commands.FaultSensor) and not self._training:
            raise UsageError("sensor faults are offered only where hmi.training is switched on")
        if isinstance(command, commands.SetSetpoint):
            limits = self._model.limits
            low, high = limits.input_low[command.place], limits.input_high[command.place]
            if high > low:  # they are known
                execution.check_bounds(command, low, high)
        token = secrets.token_urlsafe(16)
        text = f"{command.text}{self._consequences(command)}"
        premises = await self._premises(command)
        self._prepared[token] = Prepared(command, text, user, self._now() + CONFIRM_WITHIN_S, premises)
        while len(self._prepared) > MOST_PREPARED:
            self._prepared.popitem(last=False)
        now = "; ".join(f"{name} {value}" for name, value in premises.items() if name != "session")
        return Preview(token, text, now)

    async def _premises(self, command: commands.Command) -> Premises:
        async with execution.connected(self._clients(execution.WORK[type(command)][0])) as clients:
            return await read_premises(clients, command)

    def _consequences(self, command: commands.Command) -> str:
        """Return what a command means at present, beyond its own words."""
        pace, load = self._model.record("plant", common.SessionPace), self._model.record("plant", plant.LoadStatus)
        shelved_s = 0
        if isinstance(command, commands.TreatAlarm) and command.action == common.AlarmAction.SHELVE:
            shelved_s = command.time_s
        if shelved_s and pace and pace.session:
            if not pace.realtime:
                return " of plant time, which advances as it is granted"
            if pace.paused:
                return " of plant time, which is paused"
            if pace.factor != 1.0 and pace.factor > 0.0:
                length = commands.duration_text(shelved_s / pace.factor)
                return f" of plant time, {length} by the clock at factor {pace.factor:g}"
        if isinstance(command, commands.SetLoad | commands.PlayLoad) and load and load.upcoming:
            until = commands.clock_text(load.last_tick * self.process.tick_s)
            steps = f"{load.upcoming} steps" if load.upcoming > 1 else "step"
            return f"; the {steps} of the load still to come, until {until}, will be dropped"
        return ""

    async def confirm(self, token: str, user: str) -> CommandResult:
        """Carry out a command that was prepared, once.

        Raises:
            PremisesChangedError: What it was prepared for has changed; it has a new preview.
            UsageError: There is none with this token, or it is another user's, or it was prepared too long ago.
        """
        prepared = self._prepared.get(token)
        if prepared is None or prepared.user != user or self._now() > prepared.until:
            raise UsageError(
                f"nothing to confirm: a command is confirmed once, within {CONFIRM_WITHIN_S:g} s, by its own user"
            )
        del self._prepared[token]
        async with self._turn:
            try:
                changes = differences(prepared.premises, await self._premises(prepared.command))
            except LinkError as error:
                return CommandResult(prepared.text, refused_because=execution.reason_of(error))
            if changes:
                by = f"; the last command here was {self._last}" if self._last else ""
                reason = f"not done, as it has changed since it was asked: {changes}{by}"
                raise PremisesChangedError(reason, await self.prepare(prepared.command, user))
            result = await self._carry_out(prepared.command, prepared.text)
            if not result.refused_because:
                self._last = f"{user}'s: {prepared.text}"
                self._model.commands += 1
            return result

    async def _carry_out(self, command: commands.Command, asked: str) -> CommandResult:
        services, work = execution.WORK[type(command)]
        clients = self._clients(services)
        try:
            async with execution.connected(clients):
                return CommandResult(asked, applied=await work(clients, command))
        except execution.NotTakenError as error:
            return CommandResult(asked, refused_because=str(error))
        except (LinkError, UsageError) as error:
            if any(client.has_written for client in clients.values()):
                reason = f"{execution.reason_of(error)}; check its effect before repeating it"
                return CommandResult(asked, uncertain_because=reason)
            return CommandResult(asked, refused_because=execution.reason_of(error))

    def _clients(self, services: Iterable[str]) -> dict[str, execution.CommandClient]:
        ends = {service: self._endpoints[service].model_copy(update={"timeout_s": TIMEOUT_S}) for service in services}
        return execution.clients_of(ends, self.process)


@dataclass(frozen=True)
class Commanding:
    """Answers requests that change something. Without a desk there are no commands, as in a replay."""

    settings: HmiSection
    guard: Guard
    users: Users
    desk: OperatorDesk | None
    log: Audit

    def routes(self) -> list[web.AbstractRouteDef]:
        """Return what is served."""
        return [
            web.get("/api/me", self.me),
            web.post("/api/login", self.login),
            web.post("/api/logout", self.logout),
            web.get("/api/audit", self.audit),
            web.post("/api/commands", self.prepare),
            web.post("/api/commands/{token}", self.confirm),
        ]

    async def me(self, request: web.Request) -> web.Response:
        """Answer with who is asking."""
        session = self.guard.session(request)
        return web.json_response(
            {
                "user": session.user.name if session else "",
                "role": session.user.role.value if session else ("view" if self.settings.login.anonymous_view else ""),
                "operates": bool(session and session.may_operate and self.desk),
                "can_log_in": len(self.users) > 0,
            }
        )

    async def login(self, request: web.Request) -> web.Response:
        """Begin a session."""
        asked = await _document(request)
        name, password = asked.get("user"), asked.get("password")
        if not isinstance(name, str) or not isinstance(password, str):
            return refusal(400, "user and password must be text")
        address = request.remote or ""
        user = await self.guard.log_in(name, password, address, self.guard.logins)
        self.guard.sessions.end(request.cookies.get(cookie_name(request)))
        answer = web.json_response({"user": user.name, "role": user.role.value})
        answer.set_cookie(
            cookie_name(request), self.guard.sessions.begin(user), httponly=True, samesite="Strict", path="/",
            secure=self.settings.https is not None,
        )  # fmt: skip
        self.log.note("login", who=user.name, address=address, outcome="done", detail=user.role.value)
        return answer

    async def logout(self, request: web.Request) -> web.Response:
        """End the session."""
        who = self.guard.who(request)
        if who:
            self.log.note("logout", who=who, address=request.remote or "", outcome="done")
        self.guard.sessions.end(request.cookies.get(cookie_name(request)))
        answer = web.json_response({})
        answer.del_cookie(cookie_name(request), path="/")
        return answer

    async def audit(self, request: web.Request) -> web.Response:
        """Answer with the last entries of the audit, for operators."""
        self._operator(request)
        return compressed_answer(request, documents.encoded({"entries": self.log.entries[::-1]}))

    async def prepare(self, request: web.Request) -> web.Response:
        """Take a command: answer with what it would do and the token that confirms it."""
        user, desk = self._operator(request), self._required_desk()
        try:
            command = commands.read_command(await _document(request), desk.process)
            preview = await desk.prepare(command, user)
        except (UsageError, LinkError) as error:
            self._refuse(request, str(error))
            return refusal(422, str(error))
        return web.json_response(preview._asdict())

    async def confirm(self, request: web.Request) -> web.Response:
        """Carry out a prepared command; answer with the command and its result."""
        user, desk = self._operator(request), self._required_desk()
        try:
            outcome = await desk.confirm(request.match_info["token"], user)
        except (UsageError, LinkError) as error:
            self._refuse(request, str(error))
            preview = error.preview._asdict() if isinstance(error, PremisesChangedError) else {}
            return web.json_response({"error": str(error), **preview}, status=409)
        word = "refused" if outcome.refused_because else "uncertain" if outcome.uncertain_because else "done"
        detail = f"{outcome.asked}: {' '.join(filter(None, outcome[1:]))}"
        self.log.note(  # by name: the login may have ended meanwhile
            "command", who=user, address=request.remote or "", outcome=word, detail=detail
        )
        return compressed_answer(request, documents.encoded(outcome._asdict()))

    def _required_desk(self) -> OperatorDesk:
        if self.desk is None:
            raise web.HTTPConflict(reason="a recorded run takes no commands")
        return self.desk

    def _operator(self, request: web.Request) -> str:
        """Return the name of an operator; raise the refusal of anybody else."""
        session = self.guard.session(request)
        if session is None:
            self._refuse(request, "not logged in, or the session has ended")
            raise web.HTTPUnauthorized(reason="log in first: the session has ended, or there was none")
        if not session.may_operate:
            self._refuse(request, "the user may only view")
            raise web.HTTPForbidden(reason=f"{session.user.name} may view, but not operate")
        return session.user.name

    def _refuse(self, request: web.Request, reason: str) -> None:
        who = self.guard.who(request)
        self.log.refuse("command", who=who, address=request.remote or "", reason=reason, has_session=bool(who))


async def _document(request: web.Request) -> dict[str, Any]:
    """Return the JSON object of a request (HTTPBadRequest: it has none)."""
    try:
        document = await request.json(loads=parsed_json)
    except (ValueError, LookupError):  # no JSON, or no such character set
        document = None
    if not isinstance(document, dict):
        raise web.HTTPBadRequest(reason="the request is not a JSON object")
    return document
