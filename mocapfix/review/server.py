"""The server of a review: the page, its assets and its interface, on loopback, behind a token in the address.

Requests without the token, for another host, or from a page of another origin are refused. The server ends when the last page
has been closed for some seconds, or when a page asks for it.
"""

import asyncio
import json
import secrets
import socket
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from mocapfix.errors import MocapfixError, ReadError, SceneError, WriteError
from mocapfix.review.edits import EditConflictError
from mocapfix.review.take_files import trace_marker

if TYPE_CHECKING:
    from mocapfix.review.review_session import Event, OpenTake, ReviewSession


SERVER_HOST = "127.0.0.1"
SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
}


class AccessGuard:
    """Passes on requests with the token in their path, the right host and no other origin; refuses all others."""

    def __init__(self, application: ASGIApp, port: int, token: str) -> None:
        self._application, self._prefix = application, f"/{token}"
        self._hosts = {f"{name}:{port}" for name in (SERVER_HOST, "localhost")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        refusal = self._find_refusal(scope, headers)
        if refusal:
            await JSONResponse({"error": refusal}, 403)(scope, receive, send)
            return
        path = scope["path"].removeprefix(self._prefix)

        async def send_secured(message: Any) -> None:
            if message["type"] == "http.response.start":
                added = [(name.lower().encode(), value.encode()) for name, value in SECURITY_HEADERS.items()]
                message = {**message, "headers": [*message.get("headers", []), *added]}
            await send(message)

        await self._application({**scope, "path": path, "raw_path": path.encode(), "root_path": ""}, receive, send_secured)

    def _find_refusal(self, scope: Scope, headers: dict[str, str]) -> str:
        """Return why a request is refused, "" if it is not."""
        if headers.get("host", "") not in self._hosts:
            return "This host is not served."
        token = scope["path"].split("/")[1] if scope["path"].count("/") > 1 else ""
        if not secrets.compare_digest(f"/{token}".encode(), self._prefix.encode()):
            return "The address has no valid token; open the address that `mocapfix review` shows."
        origin = headers.get("origin", "")
        is_own_site = headers.get("sec-fetch-site", "same-origin") in ("same-origin", "none")
        if (origin and origin.removeprefix("http://") not in self._hosts) or not is_own_site:
            return "Pages of other origins have no access."
        if scope["method"] == "POST" and headers.get("content-type", "").split(";")[0].strip() != "application/json":
            return "Requests must be JSON."
        return ""


ASSETS_FOLDER = Path(__file__).parent / "page"
THREE_MODULE, THREE_PATH = "nicegui", Path("elements") / "scene" / "dist" / "index.js"
"""three.js with its orbit controls as one module, as NiceGUI ships it"""
PAGE_CLOSED_LIMIT_S = 10.0
KEEP_ALIVE_S = 3.0
MAX_BODY_BYTES = 1_000_000
MAX_PORT = 65_535
Handler = Callable[[Request, dict[str, Any]], Response]  # of a request and the object in its body, in a thread


class ReviewServer:
    """The server of one session. `address` is that of its page."""

    def __init__(self, session: "ReviewSession", port: int = 0) -> None:
        self.session = session
        self._token = secrets.token_urlsafe(24)
        self._socket = _open_loopback_socket(port)
        self.port = int(self._socket.getsockname()[1])
        self._page_count, self._had_page, self._must_end = 0, False, asyncio.Event()
        guard = AccessGuard(self._build_application(), self.port, self._token)
        config = uvicorn.Config(guard, log_level="critical", access_log=False, timeout_graceful_shutdown=1, lifespan="off")
        self._server = uvicorn.Server(config)

    @property
    def address(self) -> str:
        return f"http://{SERVER_HOST}:{self.port}/{self._token}/"

    def serve(self) -> None:
        """Serve until the review is closed. Raises KeyboardInterrupt if it is interrupted."""
        threading.Thread(target=self.session.read_ahead).start()  # not a daemon: one in compiled code at the end aborts Python
        try:
            asyncio.run(self._serve())
        finally:
            self.session.close()
            self._socket.close()

    def stop(self) -> None:
        """End the server from another thread."""
        self._server.should_exit = True

    async def _serve(self) -> None:
        watcher = asyncio.create_task(self._end_when_closed())
        try:
            await self._server.serve(sockets=[self._socket])
        finally:
            watcher.cancel()

    async def _end_when_closed(self) -> None:
        """End the server when a page asks for it, or when none has been open for some seconds and nothing runs."""
        closed_s = 0.0
        interval_s = 0.25
        while closed_s < PAGE_CLOSED_LIMIT_S and not self._must_end.is_set():
            await asyncio.sleep(interval_s)
            is_closed = self._had_page and not self._page_count and not self.session.is_running
            closed_s = closed_s + interval_s if is_closed else 0.0
        self.session.announce({"type": "closing"})
        await asyncio.sleep(interval_s)
        self._server.should_exit = True

    def _build_application(self) -> Starlette:
        def route(path: str, handler: Handler, method: str = "GET") -> Route:
            return Route(path, _answer(handler), methods=[method])

        take = "/api/takes/{take:path}"
        return Starlette(
            routes=[
                route("/", lambda *_: FileResponse(ASSETS_FOLDER / "page.html", media_type="text/html")),
                route("/assets/{name}", self._get_asset),
                route("/api/session", lambda *_: JSONResponse(self.session.describe())),
                Route("/api/events", self._get_events),
                route("/api/close", self._close, "POST"),
                route(f"{take}/samples", self._get_samples),
                route(f"{take}/characters", self._get_character),
                route(f"{take}/fills", self._get_fills),
                route(f"{take}/trace", self._get_trace),
                route(f"{take}/edit", self._edit, "POST"),
                route(f"{take}/clean", self._clean, "POST"),
                route(f"{take}/cancel", self._cancel, "POST"),
                route(f"{take}/approve", self._approve, "POST"),
                route(take, lambda request, _: JSONResponse(self._open(request).describe())),
            ]
        )

    def _open(self, request: Request) -> "OpenTake":
        return self.session.open_take(request.path_params["take"])

    def _get_asset(self, request: Request, _: object) -> Response:
        name = request.path_params["name"]
        media_types = {".js": "text/javascript", ".css": "text/css"}
        path = find_three_module() if name == "three.js" else ASSETS_FOLDER / Path(name).name
        if path.suffix not in media_types or not path.is_file():
            return JSONResponse({"error": "There is no such file."}, 404)
        return FileResponse(path, media_type=media_types[path.suffix])

    def _get_samples(self, request: Request, _: object) -> Response:
        frames = _read_number(request, "first"), _read_number(request, "count")
        return Response(self._open(request).view.encode_frames(*frames), media_type="application/octet-stream")

    def _get_character(self, request: Request, _: object) -> Response:
        path = self._open(request).take.find_characters().get(request.query_params.get("name", ""))
        if path is None:
            raise ReadError("There is no such character; load the page again.")
        return FileResponse(path, media_type="model/gltf-binary")

    def _get_trace(self, request: Request, _: object) -> Response:
        opened, marker = self._open(request), request.query_params.get("marker", "")
        return Response(trace_marker(opened.take, opened.view, marker).astype("<f4").tobytes())

    def _get_fills(self, request: Request, _: object) -> Response:
        stretch = request.query_params.get("marker", ""), _read_number(request, "first"), _read_number(request, "last")
        return JSONResponse(self.session.estimate_fills(request.path_params["take"], *stretch))

    def _edit(self, request: Request, body: dict[str, Any]) -> Response:
        revision, action = body.get("revision"), body.get("action")
        if not isinstance(revision, str) or not isinstance(action, dict):
            raise SceneError("The page sent an edit without its revision; load it again.")
        try:
            return JSONResponse(self.session.edit(request.path_params["take"], revision, cast("dict[str, Any]", action)))
        except EditConflictError as error:
            return JSONResponse({"error": str(error), "take": self._open(request).describe_review()}, 409)

    def _clean(self, request: Request, body: dict[str, Any]) -> Response:
        return JSONResponse(asdict(self.session.start_cleaning(request.path_params["take"], body)), 202)

    def _cancel(self, request: Request, _: object) -> Response:
        opened = self._open(request)
        opened.cancel_cleaning()
        return JSONResponse(asdict(opened.status))

    def _approve(self, request: Request, body: dict[str, Any]) -> Response:
        if not isinstance(name := body.get("name", 0), str | None):
            raise SceneError("An approval needs a name; null withdraws it.")
        return JSONResponse(self.session.approve(request.path_params["take"], name))

    def _close(self, *_: object) -> Response:
        self._must_end.set()
        return JSONResponse({})

    async def _get_events(self, request: Request) -> Response:
        loop = asyncio.get_running_loop()
        queue: asyncio.Queue[Event] = asyncio.Queue()

        def receive(event: "Event") -> None:
            loop.call_soon_threadsafe(queue.put_nowait, event)

        remove = self.session.add_listener(receive)
        self._page_count, self._had_page = self._page_count + 1, True

        async def iterate_events() -> AsyncIterator[str]:
            try:
                yield ": open\n\n"
                while not self._server.should_exit:
                    try:
                        event = await asyncio.wait_for(queue.get(), KEEP_ALIVE_S)
                    except TimeoutError:
                        yield ": still here\n\n"
                        continue
                    yield f"data: {json.dumps(event)}\n\n"
                    if event["type"] == "closing":
                        return
            finally:
                remove()
                self._page_count -= 1

        return StreamingResponse(iterate_events(), media_type="text/event-stream")


def find_three_module() -> Path:
    """Return the path of three.js. Raises ReadError if it is not installed."""
    spec = find_spec(THREE_MODULE)
    path = Path(spec.origin).parent / THREE_PATH if spec and spec.origin else None
    if path is None or not path.is_file():
        raise ReadError("The 3-D view is not installed; install it with: pip install 'mocapfix[review]'.")
    return path


def _answer(handler: Handler) -> Callable[[Request], Awaitable[Response]]:
    """Return a handler that runs in a thread, and whose errors are answers with one sentence."""

    async def handle(request: Request) -> Response:
        try:
            return await run_in_threadpool(handler, request, await _read_body(request))
        except WriteError as error:
            return JSONResponse({"error": str(error)}, 423)
        except MocapfixError as error:
            return JSONResponse({"error": str(error)}, 404 if isinstance(error, ReadError) else 422)
        except ClientDisconnect:
            return Response(status_code=400)

    return handle


async def _read_body(request: Request) -> dict[str, Any]:
    """Return the JSON object in a request. Raises SceneError."""
    if int(request.headers.get("content-length") or 0) > MAX_BODY_BYTES:
        raise SceneError("The request is too large.")
    try:
        body = json.loads(await request.body() or b"{}")
    except ValueError as error:
        raise SceneError("The request is no JSON.") from error
    if not isinstance(body, dict):
        raise SceneError("The request must be a JSON object.")
    return cast("dict[str, Any]", body)


def _read_number(request: Request, key: str) -> int:
    try:
        return max(0, int(request.query_params.get(key, "")))
    except ValueError:
        raise SceneError(f"{key} must be a number.") from None


def _open_loopback_socket(port: int) -> socket.socket:
    """Return a socket on loopback. Raises WriteError if the port is used or no port."""
    if not 0 <= port <= MAX_PORT:
        raise WriteError(f"Port {port} cannot be used (ports are 0 to {MAX_PORT}); choose another with --port, or 0 for any.")
    try:
        return socket.create_server((SERVER_HOST, port))
    except OSError as error:
        problem = error.strerror or error
        raise WriteError(f"Port {port} cannot be used ({problem}); choose another with --port, or 0 for any.") from error
