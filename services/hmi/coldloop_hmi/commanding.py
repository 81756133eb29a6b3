"""Requests that change something: login, logout, and commands in two steps."""

from typing import Any, Final

from aiohttp import web

from coldloop.errors import LinkError, UsageError
from coldloop.operating.commands import read_command
from coldloop.parsing import parsed_json
from coldloop_hmi.access import LoginSession
from coldloop_hmi.assets import compressed_answer
from coldloop_hmi.audit import Audit
from coldloop_hmi.documents import encoded
from coldloop_hmi.guard import Guard, cookie_name, refusal
from coldloop_hmi.operator_desk import OperatorDesk, PremisesChangedError
from coldloop_hmi.settings import HmiSection
from coldloop_hmi.users import Users

LONGEST_REQUEST: Final = 2_000_000
"""Bytes of a request: a load file fits."""


class Commanding:
    """Answers requests that change something.

    Args:
        settings: Of the page.
        guard: Knows who is asking.
        users: Who may log in.
        desk: Carries out commands; None where there are none, as in a replay.
        audit: Where everything is noted.
    """

    def __init__(
        self, settings: HmiSection, guard: Guard, users: Users, desk: OperatorDesk | None, audit: Audit
    ) -> None:
        self._settings = settings
        self._guard = guard
        self._users = users
        self._desk = desk
        self._audit = audit

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
        session = self._guard.session(request)
        return web.json_response(
            {
                "user": session.user.name if session else "",
                "role": session.user.role.value if session else ("view" if self._settings.login.anonymous_view else ""),
                "operates": bool(session and session.may_operate and self._desk),
                "can_log_in": len(self._users) > 0,
            }
        )

    async def login(self, request: web.Request) -> web.Response:
        """Begin a session."""
        asked = await _document(request)
        name, password = asked.get("user"), asked.get("password")
        if not isinstance(name, str) or not isinstance(password, str):
            return refusal(400, "user and password must be text")
        address = request.remote or ""
        user = await self._guard.log_in(name, password, address, self._guard.logins)
        if isinstance(user, web.Response):
            return user
        self._guard.sessions.end(request.cookies.get(cookie_name(request)))
        answer = web.json_response({"user": user.name, "role": user.role.value})
        answer.set_cookie(
            cookie_name(request), self._guard.sessions.begin(user), httponly=True, samesite="Strict", path="/",
            secure=self._settings.https is not None,
        )  # fmt: skip
        self._audit.note("login", who=user.name, address=address, outcome="done", detail=user.role.value)
        return answer

    async def logout(self, request: web.Request) -> web.Response:
        """End the session."""
        who = self._guard.who(request)
        if who:
            self._audit.note("logout", who=who, address=request.remote or "", outcome="done")
        self._guard.sessions.end(request.cookies.get(cookie_name(request)))
        answer = web.json_response({})
        answer.del_cookie(cookie_name(request), path="/")
        return answer

    async def audit(self, request: web.Request) -> web.Response:
        """Answer with the last entries of the audit, for operators."""
        operator = self._operator(request)
        if isinstance(operator, web.Response):
            return operator
        return compressed_answer(request, encoded({"entries": self._audit.entries[::-1]}))

    async def prepare(self, request: web.Request) -> web.Response:
        """Take a command: answer with what it would do and the token that confirms it."""
        operator = self._operator(request)
        if isinstance(operator, web.Response) or self._desk is None:
            return operator if isinstance(operator, web.Response) else refusal(409, "a recorded run takes no commands")
        try:
            command = read_command(await _document(request), self._desk.process)
            preview = await self._desk.prepare(command, operator.user.name)
        except (UsageError, LinkError) as error:
            self._refuse(request, str(error))
            return refusal(422, str(error))
        return web.json_response(preview._asdict())

    async def confirm(self, request: web.Request) -> web.Response:
        """Carry out a prepared command; answer with the command and its result."""
        operator = self._operator(request)
        if isinstance(operator, web.Response) or self._desk is None:
            return operator if isinstance(operator, web.Response) else refusal(409, "a recorded run takes no commands")
        try:
            outcome = await self._desk.confirm(request.match_info["token"], operator.user.name)
        except (UsageError, LinkError) as error:
            self._refuse(request, str(error))
            preview = error.preview._asdict() if isinstance(error, PremisesChangedError) else {}
            return web.json_response({"error": str(error), **preview}, status=409)
        word = "refused" if outcome.refused_because else "uncertain" if outcome.uncertain_because else "done"
        detail = f"{outcome.asked}: {' '.join(filter(None, outcome[1:]))}"
        self._audit.note(  # by name: the login may have ended meanwhile
            "command", who=operator.user.name, address=request.remote or "", outcome=word, detail=detail
        )
        return compressed_answer(request, encoded(outcome._asdict()))

    def _operator(self, request: web.Request) -> LoginSession | web.Response:
        """Return the session of an operator, or the refusal."""
        session = self._guard.session(request)
        if session is None:
            self._refuse(request, "not logged in, or the session has ended")
            return refusal(401, "log in first: the session has ended, or there was none")
        if not session.may_operate:
            self._refuse(request, "the user may only view")
            return refusal(403, f"{session.user.name} may view, but not operate")
        return session

    def _refuse(self, request: web.Request, reason: str) -> None:
        who = self._guard.who(request)
        self._audit.refuse("command", who=who, address=request.remote or "", reason=reason, has_session=bool(who))


async def _document(request: web.Request) -> dict[str, Any]:
    """Return the JSON object of a request.

    Raises:
        HTTPBadRequest: It has none.
    """
    try:
        document = await request.json(loads=parsed_json)
    except (ValueError, LookupError):  # no JSON, or no such character set
        document = None
    if not isinstance(document, dict):
        raise web.HTTPBadRequest(reason="the request is not a JSON object")
    return document
