"""The explorer's page, as far as its server can tell: requests over HTTP."""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from sierra.extensions.explorer.server import Server
from tests.waiting import PATIENCE_S


class Page:
    """The explorer's page, as far as the server can tell."""

    def __init__(self, url: str) -> None:
        """`url`: the address that `sierra explore` prints."""
        address, _, self.token = url.partition("#")
        self.host = address.removeprefix("http://").rstrip("/")
        self.headers = {"X-Sierra-Token": self.token, "Host": self.host, "Origin": f"http://{self.host}"}

    def send(self, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, bytes, Mapping[str, str]]:
        """Send a request; a header that is "" is left out."""
        connection = http.client.HTTPConnection(self.host, timeout=PATIENCE_S)
        given = {
            "Content-Length": str(len(body)),
            **self.headers,
            **{name.replace("_", "-"): one for name, one in headers.items()},
        }
        connection.putrequest(method, path, skip_host=True)
        for name, value in given.items():
            if value:
                connection.putheader(name, value)
        connection.endheaders(body)
        answer = connection.getresponse()
        found = answer.status, answer.read(), dict(answer.getheaders())
        connection.close()
        return found

    def ask(self, question: str, /, **content: Any) -> Any:
        """Return an answer; AssertionError with the error if there is none."""
        status, body, _ = self.send("POST", f"/ask/{question}", json.dumps(content).encode())
        found = json.loads(body)
        assert status == 200, found["error"]
        return found

    def error(self, question: str, /, **content: Any) -> str:
        status, body, _ = self.send("POST", f"/ask/{question}", json.dumps(content).encode())
        assert status == 400
        text: str = json.loads(body)["error"]
        assert "\n" not in text
        return text


@contextmanager
def served(server: Server) -> Iterator[Page]:
    thread = threading.Thread(target=server.serve)
    thread.start()
    try:
        yield Page(server.url)
    finally:
        server.close()
        thread.join()
