"""The endpoints: what is asked of `Served`, in which thread, and how errors are told."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any, Literal

from fastapi import Body, FastAPI, Header, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, PlainTextResponse, Response
from pydantic import BaseModel
from starlette.exceptions import HTTPException

from fpcal_bayes.analysis.watch import stamp
from fpcal_bayes.cli.serve.guard import answer
from fpcal_bayes.cli.serve.state import Asked, RefusedError, Served, StateError
from fpcal_bayes.core.errors import HeldError, InputError, reason
from fpcal_bayes.core.files import CONTENT_HASH
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.core.version import __version__

#: Seconds for which a decision or a page is given again, and how many that differ may wait to be worked out.
_FRESH_S, _MOST_WAITING = 30.0, 8
#: Seconds that sweeps wait for a campaign that is being written, and between looks at the estimate ahead of requests.
_PATIENCE_S, _LOOK_S = 20.0, 0.5


class ErrorBody(BaseModel):
    """Every error."""

    kind: Literal["request", "token", "refused", "state", "held", "busy", "internal"]
    message: str
    despite: str | None = None


class ErrorAnswer(BaseModel):
    """The one form of errors."""

    error: ErrorBody


class _Slow:
    """Answers that take long, worked out one after the other, once for all who ask meanwhile."""

    def __init__(self) -> None:
        self._pool, self._made = ThreadPoolExecutor(1), dict[object, asyncio.Future[Any]]()

    async def get(self, key: object, work: Callable[[], Any]) -> Any:
        if key not in self._made:
            for old in [old for old, future in self._made.items() if future.done()][: -_MOST_WAITING or None]:
                del self._made[old]
            if sum(not future.done() for future in self._made.values()) >= _MOST_WAITING:
                raise HTTPException(429, "others are being answered: ask again in a few seconds")
            self._made[key] = asyncio.get_running_loop().run_in_executor(self._pool, work)
        try:
            return await asyncio.shield(self._made[key])
        except Exception:
            self._made.pop(key, None)
            raise


def make_app(served: Served) -> FastAPI:
    """The application that answers for a cell."""
    quick, writer, slow = ThreadPoolExecutor(2), ThreadPoolExecutor(1), _Slow()

    async def within(pool: ThreadPoolExecutor, work: Callable[..., Any], *given: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(pool, work, *given)

    async def worked_out(name: str, work: Callable[..., Any], *given: Any) -> Any:
        """What is worked out from the campaign, while it stays as it is and for half a minute."""
        key = name, given, stamp(served.files.campaign), served.now() // _FRESH_S
        try:
            return await slow.get(key, lambda: work(*given))
        except InputError as error:
            raise error if isinstance(error, HeldError | StateError) else StateError(str(error)) from error

    @contextlib.asynccontextmanager
    async def look_ahead(_: FastAPI) -> AsyncIterator[None]:
        async def look() -> None:
            while True:
                with contextlib.suppress(Exception):
                    await within(quick, lambda: served.current().prepare())
                await asyncio.sleep(_LOOK_S)

        looking = asyncio.create_task(look())
        yield
        looking.cancel()

    app = FastAPI(
        title="fpcal serve",
        version=__version__,
        description="Lengths in um, angles in deg. Every error has one form; with the query always_200=1 it comes with "
        "status 200, for clients that cannot read the body of another.",
        docs_url=None,
        redoc_url=None,
        lifespan=look_ahead,
        responses={"default": {"model": ErrorAnswer, "description": "the one form of errors"}},
    )

    @app.get("/estimate")
    async def estimate(flat: bool = False, if_none_match: Annotated[str | None, Header()] = None) -> Response:
        """The current best estimate with the verdict of now; `flat`: as fpcal_ik.m and LabVIEW read it."""
        content, text = await within(quick, served.estimate, flat)
        headers = {"ETag": f'"{content[CONTENT_HASH]}"', "Cache-Control": "no-cache"}
        if if_none_match is not None and headers["ETag"] in if_none_match:
            return Response(status_code=304, headers=headers)
        return Response(text, 200, headers, media_type="application/json")

    @app.post("/joints")
    async def joints(asked: Asked) -> Response:
        """Joint values for poses, or of a task, with the predicted standard deviation of the cavity length."""
        return answer(200, await within(quick, served.joints, asked))

    @app.get("/decision")
    async def decision() -> Response:
        """Whether to measure now, and what, as fpcal decide says it."""
        return answer(200, await worked_out("decision", served.decision))

    @app.get("/suggest")
    async def suggest(n: Annotated[int, Query(ge=1, le=64)] = 4) -> Response:
        """The next sweeps that tell most about the tasks, the most useful first."""
        return answer(200, await worked_out("suggest", served.suggest, n))

    @app.post("/sweeps", status_code=201)
    async def sweeps(text: Annotated[str, Body(media_type="text/csv")]) -> Response:
        """Add a measured session to the campaign: a CSV of sweeps, as fpcal append takes it."""
        end = asyncio.get_running_loop().time() + _PATIENCE_S
        while True:
            try:
                return answer(201, await within(writer, served.append, text))
            except HeldError:
                if asyncio.get_running_loop().time() > end:
                    raise
                await asyncio.sleep(_LOOK_S)

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    @app.get("/report", response_class=HTMLResponse)
    async def report() -> Response:
        """The campaign's page, which loads itself again."""
        page = await worked_out("report", served.report)
        return HTMLResponse(page, headers={"Refresh": str(int(2 * _FRESH_S)), "Cache-Control": "no-cache"})

    @app.get("/health")
    async def health() -> Response:
        """Whether there is an estimate to be driven with."""
        cell = served.cell
        content: dict[str, Any] = {"status": "ok", "version": __version__, "cell": cell.name, "opd": cell.opd}
        content |= {"joint_names": list(cell.joint_columns), "campaign": served.files.campaign.is_file()}
        try:
            found, _ = await within(quick, served.estimate)
            content |= {name: found[name] for name in ("trust", "valid_until_utc", CONTENT_HASH)}
        except InputError as error:
            content |= {"status": "no estimate", "reason": str(error)}
        return answer(200, content)

    @app.get("/clients/{name}", response_class=PlainTextResponse)
    async def clients(name: Literal["fpcal_client.m", "fpcal_client.py", "fpcal_ik.m", "fpcal_fk.m"]) -> Response:
        """Programs that ask."""
        folder = "python" if name.endswith(".py") else "matlab"
        return PlainTextResponse(data_file(f"{folder}/{name}").read_text(encoding="utf-8"))

    @app.exception_handler(InputError)
    @app.exception_handler(RequestValidationError)
    @app.exception_handler(HTTPException)
    @app.exception_handler(Exception)
    async def failed(request: Request, error: Exception) -> Response:
        more: dict[str, Any] = {}
        code, kind, message = 500, "internal", reason(error)
        if isinstance(error, RequestValidationError):
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            code, kind, message = 422, "request", f"{place}: {first['msg']}, found {str(first.get('input'))[:40]!r}"
        elif isinstance(error, HTTPException):
            code, kind, message = error.status_code, "busy" if error.status_code == 429 else "request", error.detail
        elif isinstance(error, RefusedError):
            code, kind, more = 409, "refused", {"despite": error.despite}
        elif isinstance(error, InputError):
            kinds = ((HeldError, 423, "held"), (StateError, 409, "state"), (InputError, 422, "request"))
            code, kind = next((code, kind) for of, code, kind in kinds if isinstance(error, of))
        shown = 200 if "always_200=1" in request.url.query else code
        return answer(shown, {"error": {"kind": kind, "message": message, **more}}, getattr(error, "headers", None))

    return app
