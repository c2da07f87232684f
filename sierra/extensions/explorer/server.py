"""The server of the explorer: it listens on 127.0.0.1 only, and answers only the page that it sent.

Other programs and other pages in the browser can reach the port, too. Therefore, a question needs a random token, which is in
the fragment of the page's address and is sent in a header; its `Host` must be this server, so that no other name can point
here; and its `Origin`, if there is one, must be this server.
"""

from __future__ import annotations

import hmac
import json
import secrets
import socket
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import SEEK_END, BufferedReader, RawIOBase
from typing import TYPE_CHECKING, cast

from sierra.config.field_types import RawTable, Table
from sierra.config.validate import options
from sierra.errors import Missing, SierraError
from sierra.extensions.explorer.answers import Answers
from sierra.extensions.explorer.declarations import Kind
from sierra.extensions.explorer.page import page
from sierra.extensions.explorer.ranges import BadRange, Range
from sierra.extensions.explorer.tickets import ServedFile
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import regex
from sierra.util.lazy_logger import Log

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

log = Log(__name__)
ADDRESS = "127.0.0.1"
KEY_HEADER = "X-Sierra-Token"
LONGEST = 1 << 20
"""The most bytes of a question."""
DIGITS = regex(r"[0-9]{1,10}")
SILENCE_S = 30.0
"""The seconds in which a client must begin a request, and then those in which it must have sent all of it."""
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'self'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of all answers. The page has a stricter policy for its own content within it."""


class _Nothing(Table):
    pass


class _Tables(Table):
    batch: str | None = None


class _Batch(Table):
    batch: str


class _Batches(Table):
    words: str = ""
    first: int = 0
    again: bool = False


class _Compare(Table):
    batches: tuple[str, ...]
    name: str
    keys: RawTable


class _Runs(Table):
    where: str = ""
    order: str = ""
    columns: tuple[str, ...] = ()
    first: int = 0
    descending: bool = False


class _Run(Table):
    run: str


class _File(Table):
    run: str
    path: str


class _Curves(Table):
    runs: tuple[str, ...]
    column: str


class _Differ(Table):
    runs: tuple[str, ...]


class _Query(Table):
    statement: str
    batch: str | None = None


class _Chart(Table):
    batch: str
    name: str
    keys: RawTable
    others: tuple[str, ...] = ()


class _Write(Table):
    name: str
    keys: RawTable
    file: str
    kind: Kind = "figures"


QUESTIONS: Mapping[str, type[Table]] = {
    "overview": _Nothing,
    "batches": _Batches,
    "columns": _Nothing,
    "runs": _Runs,
    "run": _Run,
    "file": _File,
    "why": _Run,
    "curves": _Curves,
    "differ": _Differ,
    "state": _Nothing,
    "tables": _Tables,
    "batch": _Batch,
    "query": _Query,
    "chart": _Chart,
    "compare": _Compare,
    "report": _Batch,
    "progress": _Nothing,
    "write": _Write,
    "stop": _Nothing,
}
"""The fields of each question, by the name of the method of `Answers` that answers it."""


class Server:
    """A server that is ready as soon as it exists; `serve` answers until `close` is called by another thread."""

    def __init__(self, answers: Answers, title: str, port: int = 0) -> None:
        """`port`: 0 takes a free one. Raises Missing if it is taken."""
        try:
            self._http = _Http((ADDRESS, port), _Handler)
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or error
            raise Missing(f"cannot listen on port {port} of {ADDRESS} ({why}); choose another one with --port") from error
        self.port: int = self._http.server_address[1]
        self._http.answers = answers
        self._http.page = page(title)
        self._http.names = {f"{name}:{self.port}" for name in (ADDRESS, "localhost")}
        self._http.token = secrets.token_urlsafe(32)
        self._serving = False

    @property
    def token(self) -> str:
        """Return the secret that each question must have in the header `X-Sierra-Token`."""
        return self._http.token

    @property
    def url(self) -> str:
        """Return the address of the page, with the token."""
        return f"http://{ADDRESS}:{self.port}/#{self._http.token}"

    def serve(self) -> None:
        self._serving = True
        threading.Thread(target=_prepare, daemon=True).start()
        self._http.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Stop serving, and free the port."""
        self._http.answers.stop()
        if self._serving:
            self._http.shutdown()
        self._http.server_close()
        self._http.answers.close()


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    answers: Answers
    page: bytes
    names: set[str]
    token: str

    def handle_error(self, request: object, client_address: object) -> None:
        """Report a fault in SIERRA, or a client that went away, without ending the server."""
        log.warning("the explorer did not answer a request of %s: %s", client_address, traceback.format_exc())


class _Handler(BaseHTTPRequestHandler):
    server: _Http
    protocol_version = "HTTP/1.1"
    server_version = "SIERRA"
    sys_version = ""
    timeout = SILENCE_S
    disable_nagle_algorithm = True

    def setup(self) -> None:
        super().setup()
        self.rfile.close()
        self._requests = _Requests(self.connection)
        self.rfile = BufferedReader(self._requests)

    def handle_one_request(self) -> None:
        self._requests.begin()
        super().handle_one_request()

    def do_GET(self) -> None:
        if not self._is_ours():
            self._refuse(HTTPStatus.FORBIDDEN, "this address is not that of the explorer")
        elif self.path == "/":
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page)
        elif made := self.server.answers.tickets.find(self.path):
            self._send_made(made)
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is only one page")

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        if not self._is_ours() or not self._has_token():
            self._refuse(HTTPStatus.FORBIDDEN, "open the address that sierra explore has printed")
        elif not DIGITS.fullmatch(length) or int(length) > LONGEST:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a question has at most {LONGEST:,} bytes")
        elif (name := self.path.removeprefix("/ask/")) not in QUESTIONS:
            self._refuse(HTTPStatus.NOT_FOUND, "unknown question")
        else:
            self._answer(name, self.rfile.read(int(length)))

    def _send_made(self, served: ServedFile) -> None:
        """Send a page or a file, or the part of it that the browser wants."""
        try:
            with served.open() as file:
                wanted = Range.of(self.headers.get("Range"), file.seek(0, SEEK_END))
                file.seek(wanted.start)
                self._begin(wanted.status, served.kind, wanted.length, wanted.headers)
                for length in wanted.pieces():
                    self.wfile.write(file.read(length))
        except BadRange as error:
            self._refuse(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, str(error))
        except (FileNotFoundError, SierraError):
            self._refuse(HTTPStatus.NOT_FOUND, "the file has been removed, or was changed")

    def _answer(self, name: str, body: bytes) -> None:
        try:
            asked = options(QUESTIONS[name], json.loads(body), f"question {name}")
        except (SierraError, ValueError, RecursionError) as error:
            why = str(error) if isinstance(error, SierraError) else f"not a question: {error}"
            self._say(HTTPStatus.BAD_REQUEST, {"error": why})
            return
        try:
            method = cast("Callable[..., JsonView]", getattr(self.server.answers, name))
            with self.server.answers.plugins():
                answer = method(**{field: getattr(asked, field) for field in QUESTIONS[name].model_fields})
        except SierraError as error:
            self._say(HTTPStatus.BAD_REQUEST, {"error": str(error)})
        except Exception as error:
            log.warning("a fault in SIERRA itself: %s", traceback.format_exc())
            self._say(HTTPStatus.INTERNAL_SERVER_ERROR, {"error": f"a fault in SIERRA itself: {type(error).__name__}: {error}"})
        else:
            self._say(HTTPStatus.OK, answer)

    def _has_token(self) -> bool:
        return hmac.compare_digest(self.headers.get(KEY_HEADER, "").encode(), self.server.token.encode())

    def _is_ours(self) -> bool:
        """Return whether a request is for this server by its name, and from its own page if a browser says where it is from."""
        hosts, origins = self.headers.get_all("Host", []), self.headers.get_all("Origin", [])
        ours = {f"http://{name}" for name in self.server.names}
        return len(hosts) == 1 and hosts[0] in self.server.names and all(origin in ours for origin in origins)

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self.close_connection = True  # the rest of the request is not read
        self._say(status, {"error": why})

    def _say(self, status: HTTPStatus, content: JsonView) -> None:
        self._send(status, "application/json", json.dumps(content, allow_nan=False).encode())

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self._begin(status, kind, len(body))
        self.wfile.write(body)

    def _begin(self, status: HTTPStatus, kind: str, length: int, more: Mapping[str, str] | None = None) -> None:
        """Send the headers of an answer of this length, in bytes."""
        self.send_response(status)
        for name, value in {**HEADERS, "Content-Type": kind, "Content-Length": str(length), **(more or {})}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        log.debug(format, *args)


class _Requests(RawIOBase):
    """The bytes that a client sends; a request that comes too slowly as a whole raises TimeoutError."""

    def __init__(self, client: socket.socket) -> None:
        self._client = client
        self._due: float | None = None

    def begin(self) -> None:
        """Begin with the next request, whose time begins with its first byte."""
        self._due = None

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer) -> int:
        left = SILENCE_S if self._due is None else self._due - time.monotonic()
        if left <= 0:
            raise TimeoutError
        self._client.settimeout(left)
        try:
            return self._client.recv_into(buffer)
        finally:
            self._client.settimeout(SILENCE_S)
            if self._due is None:
                self._due = time.monotonic() + SILENCE_S


def _prepare() -> None:
    """Load what the first chart needs, so that it does not wait for it."""
    import pyarrow.compute  # noqa: F401

    from sierra.deliverables.figures import interactive, style, summary, timeseries  # noqa: F401
    from sierra.stats import aggregate  # noqa: F401

    with style.settings():  # also reads the font
        pass
