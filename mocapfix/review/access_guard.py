"""Who has access to the server of a review: pages with the token in their address, on this computer, of no other origin."""

import secrets
from typing import Any

from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

SERVER_HOST = "127.0.0.1"
SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
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
        if origin and origin.removeprefix("http://") not in self._hosts:
            return "Pages of other origins have no access."
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return "Pages of other origins have no access."
        if scope["method"] == "POST" and headers.get("content-type", "").split(";")[0].strip() != "application/json":
            return "Requests must be JSON."
        return ""
