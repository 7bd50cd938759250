"""A scene as one page of HTML without external files, in a file or served on the loopback address."""

import base64
import json
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from cnpgen.addons.view.view_bodies import Body
from cnpgen.addons.view.view_scene import View, ViewScene
from cnpgen.arrays import AnyArray
from cnpgen.errors import CnpgenError, MachineError, UsageError, requires_extra

HOST = "127.0.0.1"
# Accepted Host headers; requests that another site redirected have other ones.
_NAMES = HOST, "localhost"
_CONNECTION_TIME_S = 10.0  # of one read or write: idle connections are closed then
_MAX_ROW_DIGITS = 18
_RETRY_S = 2  # time after which a browser reloads an error page

Page = Callable[[int | None, str], str]


def page_of(scene: ViewScene, *, stamp: str = "") -> str:
    """Write a scene as a page; a served one reloads when the server has another stamp of the files behind it.

    Raises:
        MissingExtraError: MeshCat is not installed.
    """
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    content = vars(scene) | {"stamp": stamp}
    data = json.dumps(content, default=_encoded, separators=(",", ":")).replace(
        "<", "\\u003c"
    )
    before, between = template.split("/*VIEWER*/")
    return before + _viewer() + between.replace("/*DATA*/", data)


def _viewer() -> str:
    """Return MeshCat's viewer, which includes three.js, as a script."""
    from importlib.metadata import distribution

    with requires_extra("view", "MeshCat's viewer"):
        path = Path(
            str(distribution("meshcat").locate_file("meshcat/viewer/dist/main.min.js"))
        )
        return path.read_text(encoding="utf-8")


def _encoded(value: View | Body | AnyArray) -> Any:
    """Return an object for JSON.

    Arrays as base64 of their bytes, with 4 bytes per number.
    """
    if isinstance(value, np.ndarray):
        dtype = "<f4" if value.dtype.kind == "f" else "<u4"
        return base64.b64encode(np.ascontiguousarray(value, dtype).tobytes()).decode()
    return vars(value)


def serve(
    page: Page, watched: Sequence[Path], *, port: int, ready: Callable[[str], None]
) -> None:
    """Serve a page until the process is interrupted.

    ``/?row=I`` shows another row. An open page checks every second whether it is out of
    date, and then reloads.

    Args:
        page: (row or None, stamp of the files) -> the page as HTML. Its errors are
            shown in place of the page.
        watched: The files that the page depends on; for a recipe also the other files
            in its folder.
        port: Port on the loopback address; 0 for any free port. MachineError if it is
            taken.
        ready: Called with the address once it is served.
    """
    try:
        server = _Server(page, watched, port)
    except OSError as error:
        raise MachineError(
            f"--serve: cannot listen on port {port}: {error.strerror}"
        ) from error
    with server:
        ready(f"http://{HOST}:{server.server_port}/")
        server.serve_forever()


class _Handler(BaseHTTPRequestHandler):
    """Answers to the requests of one connection."""

    timeout = _CONNECTION_TIME_S  # of every read and write
    server: "_Server"

    def do_GET(self) -> None:
        """Answer a request."""
        try:
            address = urlsplit(self.path)
        except ValueError:  # such as "http://["
            self._answer("not an address", status=HTTPStatus.BAD_REQUEST)
            return
        if (self.headers.get("Host") or "").rpartition(":")[0] not in _NAMES:
            self._answer(
                "expected the address of this machine", status=HTTPStatus.FORBIDDEN
            )
        elif address.path == "/stamp":
            self._answer(stamp(self.server.watched))
        elif address.path == "/":
            self._show(parse_qs(address.query).get("row", [""])[-1])
        else:
            self._answer("there is one page, /", status=HTTPStatus.NOT_FOUND)

    def _show(self, row: str) -> None:
        try:
            if row and not (
                row.isascii() and row.isdigit() and len(row) <= _MAX_ROW_DIGITS
            ):
                raise UsageError(f"row: expected a number from 0, got {row[:20]!r}")
            self._answer(self.server.draw(int(row) if row else None), kind="text/html")
        except CnpgenError as error:
            self._answer(str(error), status=HTTPStatus.INTERNAL_SERVER_ERROR)

    def _answer(
        self,
        text: str,
        *,
        kind: str = "text/plain",
        status: HTTPStatus = HTTPStatus.OK,
    ) -> None:
        body = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        if status is HTTPStatus.INTERNAL_SERVER_ERROR:
            self.send_header("Refresh", str(_RETRY_S))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Do not log requests."""


class _Server(ThreadingHTTPServer):
    """Server of a page and of the stamp of the files that it depends on."""

    # An idle connection does not delay the end.
    daemon_threads = True

    def __init__(self, page: Page, watched: Sequence[Path], port: int) -> None:
        self.watched = watched
        self._page = page
        # Pages are drawn one after the other.
        self._drawing = Lock()
        super().__init__((HOST, port), _Handler)

    def draw(self, row: int | None) -> str:
        """Draw the page."""
        with self._drawing:
            return self._page(row, stamp(self.watched))

    def handle_error(self, request: object, client_address: object) -> None:  # noqa: ARG002
        """Report an error of one connection in one line; clients that leave are no error."""
        error = sys.exception()
        if not isinstance(error, ConnectionError | TimeoutError):
            text = f"{type(error).__name__}: {error}".partition("\n")[0]
            print(f"cnpgen: --serve: {text[:200]}", file=sys.stderr)


def stamp(watched: Sequence[Path]) -> str:
    """Return a text that changes when one of the files does."""
    files = [
        each
        for path in watched
        for each in (path.parent.glob("*") if path.suffix == ".toml" else (path,))
    ]
    return " ".join(sorted(map(_state, files)))


def _state(path: Path) -> str:
    with suppress(OSError):
        status = path.stat()
        return f"{path.name}:{status.st_mtime_ns}:{status.st_size}"
    return f"{path.name}:missing"
