"""A page in headless Chromium, driven over the browser's debugging pipe: no driver program, no package."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

#: Software drawing, so that pictures do not depend on a graphics card, and no traffic of the browser's own.
_OPTIONS = (
    "--headless --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --hide-scrollbars "
    "--disable-quic --no-first-run --disable-background-networking --disable-component-update --disable-sync "
    "--disable-dev-shm-usage --remote-debugging-pipe"
)


def chromium() -> str | None:
    """The program of a Chromium on the PATH; None where there is none."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next((found for found in map(shutil.which, names) if found), None)


class Browser:
    """One page of a Chromium of its own, with what it complained about.

    Use it as a context: the browser ends with it.

    Args:
        width, height: of the window [pixels].

    Raises:
        FileNotFoundError: there is no Chromium.
    """

    def __init__(self, width: int = 960, height: int = 800) -> None:
        program = chromium()
        if program is None:
            raise FileNotFoundError("Chromium is not on the PATH (chromium, chromium-browser or google-chrome)")
        self._folder = tempfile.TemporaryDirectory(prefix="hood-browser-", ignore_cleanup_errors=True)
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        command = [program, *_OPTIONS.split(), f"--window-size={width},{height}", f"--user-data-dir={self._folder.name}"]
        self._process = _start(command, to_browser, from_browser)
        os.close(to_browser)
        os.close(from_browser)
        self._buffer, self._count, self._session = b"", 0, ""
        #: Errors and warnings of the page's console, and errors that nothing caught.
        self.complaints: list[str] = []
        target = self.call("Target.createTarget", url="about:blank", newWindow=True, width=width, height=height)["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for end in (self._write, self._read):
            os.close(end)  # the browser ends when its pipe does
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._folder.cleanup()

    def open(self, page: Path) -> None:
        """Show a file and wait until its program has set ``data-ready`` on the body.

        Raises:
            RuntimeError: the page did not get ready within a minute.
        """
        self.call("Page.navigate", url=page.absolute().as_uri())
        self.run(
            "new Promise((done, fail) => { const end = performance.now() + 60000; const look = () => "
            "document.body && document.body.dataset.ready === 'yes' ? done() : performance.now() > end ? "
            "fail(new Error('not ready: ' + document.body.innerText.slice(0, 300))) : setTimeout(look, 50); look(); })"
        )

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression in the page; a promise is awaited.

        Raises:
            RuntimeError: the expression failed.
        """
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True, userGesture=True)
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise RuntimeError(str(details.get("exception", {}).get("description", details.get("text"))))
        return answer["result"].get("value")

    def before(self, script: str) -> None:
        """Run ``script`` in every page that is opened from now on, before the page's own programs."""
        self.call("Page.addScriptToEvaluateOnNewDocument", source=script)

    def downloads(self, folder: Path) -> None:
        """Keep what the page saves in ``folder``."""
        self.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(folder.absolute()))

    def press(self, x: float, y: float) -> None:
        """Press and release the mouse at a place of the window [pixels]."""
        for kind in ("mousePressed", "mouseReleased"):
            buttons = 1 if kind == "mousePressed" else 0
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    def call(self, method: str, **values: Any) -> dict[str, Any]:
        """Answer to one command of the Chrome DevTools Protocol.

        Raises:
            RuntimeError: the browser refused it, or is gone.
        """
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": values}
        if self._session:
            message["sessionId"] = self._session
        _write_all(self._write, json.dumps(message).encode() + b"\0")
        while True:
            said = self._next()
            if said.get("id") == self._count:
                if "error" in said:
                    raise RuntimeError(f"{method}: {said['error']['message']}")
                result: dict[str, Any] = said["result"]
                return result
            self._note(said)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            more = os.read(self._read, 1 << 20)
            if not more:
                raise RuntimeError("the browser ended")
            self._buffer += more
        text, self._buffer = self._buffer.split(b"\0", 1)
        said: dict[str, Any] = json.loads(text)
        return said

    def _note(self, said: dict[str, Any]) -> None:
        values = said.get("params", {})
        if said.get("method") == "Runtime.exceptionThrown":
            details = values["exceptionDetails"]
            self.complaints.append(str(details.get("exception", {}).get("description", details["text"])))
        elif said.get("method") == "Runtime.consoleAPICalled" and values["type"] in ("error", "warning", "assert"):
            self.complaints.append(" ".join(str(part.get("value", part.get("description"))) for part in values["args"]))
        elif said.get("method") == "Log.entryAdded" and values["entry"]["level"] == "error":
            self.complaints.append(values["entry"]["text"])


def _start(command: Sequence[str], reads: int, writes: int) -> subprocess.Popen[bytes]:
    """The browser, which reads commands from descriptor 3 and answers on 4; a shell moves them there."""
    high = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in (reads, writes)]  # not 3 or 4 themselves
    moved = f'exec 3<&{high[0]} 4>&{high[1]}; exec "$@"'
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(
        ["bash", "-c", moved, "browser", *command], stdin=quiet, stdout=quiet, stderr=quiet, pass_fds=high
    )
    for end in high:
        os.close(end)
    return process


def _write_all(end: int, text: bytes) -> None:
    while text:
        text = text[os.write(end, text) :]
