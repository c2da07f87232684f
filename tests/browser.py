"""A real Chromium without a window, controlled through pipes by its DevTools protocol, so that no library is needed.

https://chromedevtools.github.io/devtools-protocol/: messages are JSON, each ended by a NUL.
"""

from __future__ import annotations

import base64
import json
import os
import select
import subprocess
import time
from pathlib import Path
from typing import Any

PATIENCE_S = 120.0
"""The longest time that an answer of the browser may take. Pages are slow on a busy machine."""

INJECTED = """new Promise(done => {
  const blocked = [];
  window.executed = 0;
  addEventListener('securitypolicyviolation', event => {
    blocked.push(event.effectiveDirective);
    if (blocked.length === 2) done([...blocked.sort(), executed]);
  });
  document.body.insertAdjacentHTML('beforeend', '<img src="data:," onerror="executed += 1">');
  document.body.append(Object.assign(document.createElement('script'), { textContent: 'executed += 1' }));
})"""
"""Insert scripts into a page; the value is what its policy has blocked, and the number of those that were executed."""


class Browser:
    """One page of a browser. `console` and `requests` are what the page wrote and asked for since it was opened."""

    def __init__(self, program: str, folder: Path) -> None:
        """`folder`: an empty folder for the browser's own files."""
        ours, theirs = os.pipe(), os.pipe()
        script = f'exec "$0" "$@" 3<&{ours[0]} 4>&{theirs[1]}'
        words = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run"]
        words += ["--disable-background-networking", f"--user-data-dir={folder}", "--remote-debugging-pipe", "about:blank"]
        self._process = subprocess.Popen(
            ["bash", "-c", script, program, *words],
            pass_fds=(ours[0], theirs[1]),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "HOME": str(folder)},
        )
        os.close(ours[0])
        os.close(theirs[1])
        self._out, self._in = os.fdopen(ours[1], "wb"), os.fdopen(theirs[0], "rb")
        self._number, self._rest, self._session = 0, b"", ""
        self.console: list[str] = []
        self.requests: list[str] = []
        try:
            self._attach()
        except BaseException:
            self.__exit__()
            raise

    def _attach(self) -> None:
        targets = self.call("Target.getTargets")["targetInfos"]
        target = next(one["targetId"] for one in targets if one["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self._out.close()
        self._in.close()
        self._process.kill()
        self._process.wait()

    def open(self, file: Path | str, *, width: int = 1200, height: int = 900, dark: bool = False) -> None:
        """Open a file or an address, and wait until it is drawn."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600)
        self.prefer(dark=dark)
        self.console.clear()
        self.requests.clear()
        self.call("Page.navigate", url=file if isinstance(file, str) else file.as_uri())
        self.run("new Promise(done => document.readyState == 'complete' ? done() : addEventListener('load', () => done()))")
        self.settle()

    def prefer(self, *, dark: bool) -> None:
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def settle(self) -> None:
        """Wait until what was changed is drawn."""
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done())))")

    def run(self, code: str) -> Any:
        """Return the value of an expression of JavaScript."""
        done = self.call("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in done:
            raise AssertionError(done["exceptionDetails"])
        return done["result"].get("value")

    def move(self, x: float, y: float, kind: str = "mouseMoved", button: str = "none") -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=int(kind != "mouseMoved"))

    def press(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)
        self.settle()

    def picture(self, file: Path) -> None:
        """Write a picture of the whole page as PNG."""
        shot = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)
        file.write_bytes(base64.b64decode(shot["data"]))

    def call(self, method: str, **parameters: Any) -> Any:
        """Return the result of a method of the protocol, and keep what the page says meanwhile."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._out.write(json.dumps(message).encode() + b"\0")
        self._out.flush()
        limit = time.monotonic() + PATIENCE_S
        while True:
            got = self._message(limit, method)
            if got.get("id") == self._number:
                if "error" in got:
                    raise AssertionError(f"{method}: {got['error']}")
                return got["result"]
            self._heard(got)

    def _message(self, limit: float, method: str) -> Any:
        """Return the next message. Raises AssertionError if it is not there at `limit`, a time of the monotonic clock."""
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._in], [], [], max(0.0, limit - time.monotonic()))
            assert ready, f"the browser has not answered {method} for {PATIENCE_S:g} s"
            data = os.read(self._in.fileno(), 1 << 16)
            assert data, "the browser has ended"
            self._rest += data
        whole, _, self._rest = self._rest.partition(b"\0")
        return json.loads(whole)

    def _heard(self, event: Any) -> None:
        found = event.get("params", {})
        match event.get("method"):
            case "Runtime.exceptionThrown":
                self.console.append(json.dumps(found["exceptionDetails"]))
            case "Runtime.consoleAPICalled" | "Log.entryAdded":
                self.console.append(json.dumps(found))
            case "Network.requestWillBeSent":
                self.requests.append(found["request"]["url"])
