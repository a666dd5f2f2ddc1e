"""What browsers may ask of the live page. Whatever else arrives is ignored with one line.

viser stores what a client sends before any callback sees it, so messages are looked at as they come from the network:
the address that they came by, their kind, and every value against the bounds of its control.
"""

from __future__ import annotations

import contextlib
import gc
import io
import logging
import math
import sys
import threading
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Any, TextIO
from urllib.parse import urlsplit

from franka_wm.console import say

NEARBY = ("127.0.0.1", "localhost", "::1")
"""Names of this machine: what a browser may have asked for."""
LARGEST = 16 * 1024
"""Largest message of a client [bytes]."""
RATE, BURST = 300.0, 600.0
"""Messages per second of one client, and how many at once: a dragged goal sends one for each image of the screen."""
CLIENTS = 128
"""Clients at once: each takes a descriptor and 0.2 MB."""
POLICY = "frame-ancestors 'none'; connect-src 'self' ws://{} data: blob:"
"""For browsers: no other page may hold this one in a frame, and it talks to this server alone, whatever its link says.

viser's page takes another server from `?websocket=` and runs what that one sends.
"""
LEFT = 16
"""After so many clients have left, what they held is collected."""

type Check = Callable[[Any], bool]


def is_number(value: Any, low: float, high: float) -> bool:
    """Whether a value is a number from `low` to `high`, both finite: neither NaN nor a truth value is one."""
    return type(value) in (int, float) and low <= value <= high


def is_point(value: Any, size: int, most: float) -> bool:
    """Whether a value is a list of `size` finite numbers, none larger than `most`."""
    return (
        isinstance(value, (list, tuple))
        and len(value) == size
        and all(is_number(x, -most, most) for x in value)
    )


class Gate:
    """Stands between the network and a viser server.

    Args:
        complain: called with one line for what was ignored; at most once a second.
    """

    def __init__(self, complain: Callable[[str], Any] = say):
        self._complain = complain
        self._inputs: dict[str, Check] = {}
        self._handles: dict[str, Check] = {}
        self._lock = threading.Lock()
        self._said = -math.inf
        self._unsaid = 0
        self._here = self._left = 0

    def serve(self, make: Callable[[], Any]) -> Any:
        """The viser server that `make` starts, behind this gate."""
        import websockets.asyncio.server as network
        from websockets.exceptions import InvalidMessage

        def is_worth_telling(record: logging.LogRecord) -> bool:
            """Not that somebody has connected and left without asking, as editors do that look for open ports."""
            return not (record.exc_info and isinstance(record.exc_info[1], InvalidMessage | EOFError))

        real = network.serve

        def guarded(handler: Any, *args: Any, process_request: Any, **options: Any) -> Any:
            def request(connection: Any, asked: Any) -> Any:
                if wrong := foreign(asked.headers):
                    self.ignore(f"a request {wrong}")
                    return connection.respond(
                        HTTPStatus.FORBIDDEN, f"This page does not answer a request {wrong}.\n"
                    )
                if self._here >= CLIENTS and "Upgrade" in asked.headers:
                    self.ignore(f"a client beyond {CLIENTS}, the most at once")
                    return connection.respond(
                        HTTPStatus.SERVICE_UNAVAILABLE, f"{CLIENTS} clients are here, the most at once.\n"
                    )
                answer = process_request(connection, asked)
                if answer is not None:
                    answer.headers["Content-Security-Policy"] = POLICY.format(asked.headers["Host"])
                return answer

            return real(
                self._guarded(handler), *args, process_request=request, **(options | {"max_size": LARGEST})
            )

        logging.getLogger("websockets.server").addFilter(is_worth_telling)
        network.serve = guarded  # the server binds in its constructor, and has no option for this
        try:
            with contextlib.redirect_stdout(
                io.StringIO()
            ):  # its banner; whoever serves the page says where it is
                return make()
        finally:
            network.serve = real

    def allow(self, control: Any, check: Check) -> Any:
        """Let clients set the value of a control where `check` holds; returns the control."""
        self._inputs[control._impl.uuid] = check
        return control

    def allow_drag(self, name: str, check: Check) -> None:
        """Let clients drag the handle of that name to positions where `check` holds."""
        self._handles[name] = check

    def admits(self, message: Any) -> bool:
        """Whether a decoded message is one that the page's own client sends, with values within bounds."""
        if not isinstance(message, Mapping):
            return False
        kind, values = message.get("type"), {k: v for k, v in message.items() if k not in ("type", "owner")}
        if message.get("owner", "") != "":
            return False
        if kind == "GuiUpdateMessage":
            check, updates = self._inputs.get(str(values.get("uuid"))), values.get("updates")
            if check is None or not isinstance(updates, Mapping) or set(updates) != {"value"}:
                return False
            return set(values) == {"uuid", "updates"} and check(updates["value"])
        if kind == "ViewerCameraMessage":
            sizes = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}
            numbers = ("fov", "near", "far", "image_height", "image_width")
            return set(values) == {*sizes, *numbers} and all(
                is_point(values[name], size, 1e6) for name, size in sizes.items()
            ) and all(is_number(values[name], 0, 1e6) for name in numbers)  # fmt: skip
        if (check := self._handles.get(str(values.get("name")))) is None:
            return False
        if kind == "TransformControlsUpdateMessage":
            return (
                set(values) == {"name", "wxyz", "position"}
                and is_point(values["wxyz"], 4, 2.0)
                and check(values["position"])
            )
        return (
            kind in ("TransformControlsDragStartMessage", "TransformControlsDragEndMessage")
            and len(values) == 1
        )

    def ignore(self, what: str) -> None:
        """Say that something was ignored; of many in a second only how many more there were."""
        with self._lock:
            now = time.monotonic()
            if now - self._said < 1.0:
                self._unsaid += 1
                return
            more = f" ({self._unsaid} more before it)" if self._unsaid else ""
            self._said, self._unsaid = now, 0
        self._complain(f"ignored: {what}{more}")

    def _guarded(self, handler: Any) -> Any:
        """A connection's handler that sees admitted messages only."""
        import viser
        from websockets.exceptions import ConnectionClosed

        spoken = f"viser-v{viser.__version__}"

        async def handle(connection: Any) -> None:
            if connection.subprotocol != spoken:  # viser refuses it as well, and writes a line each time
                self.ignore(f"a page of another version: {short(connection.subprotocol)}")
                await connection.close(
                    1002, f"Version mismatch: this server speaks {spoken}; reload the page."
                )
                return
            receive, left, before = connection.recv, BURST, time.monotonic()

            async def admitted() -> bytes:
                nonlocal left, before
                while True:
                    raw = await receive()
                    now = time.monotonic()
                    left, before = min(BURST, left + RATE * (now - before)) - 1, now
                    if left < 0:
                        left = 0.0
                        self.ignore(f"messages of a client that sends more than {RATE:.0f} a second")
                    elif self.admits(message := decoded(raw)):
                        return raw
                    else:
                        self.ignore(
                            f"a message that the page does not send, or a value out of range: {short(message)}"
                        )

            connection.recv = admitted
            self._here += 1
            try:
                with contextlib.suppress(ConnectionClosed):
                    await handler(connection)
            finally:
                self._here -= 1
                self._collect()

        return handle

    def _collect(self) -> None:
        """Free what clients held that have left.

        The objects of a connection hold one another, with 0.2 MB of compression buffers. Python would let hundreds of
        them wait: it looks through old objects only when a quarter of them is new.
        """
        self._left += 1
        if self._left % LEFT == 0:
            gc.collect()


class _WithoutFarewell:
    """A stream that leaves out the line in which viser says that its server has stopped."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        farewell = "(viser)" in text and text.rstrip().endswith("Server stopped")
        return len(text) if farewell else self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def stop(server: Any) -> None:
    """Stops a viser server without a word on the terminal, for which it has no option; errors are shown."""
    shown: Any = _WithoutFarewell(sys.stdout)
    with contextlib.redirect_stdout(shown):
        server.stop()


def foreign(headers: Any) -> str | None:
    """Why a request is not one of this page in a browser on this machine; None if it is.

    A browser tells with each WebSocket which page opened it (`Origin`), and which name it asked for (`Host`): that of
    another site whose name was made to point here is still its own.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    try:
        host = urlsplit(f"//{hosts[0]}").hostname if len(hosts) == 1 else None
    except ValueError:
        host = None
    if host not in NEARBY:
        return f"for another host than this machine: {short(', '.join(hosts))}"
    if len(origins) > 1 or (origins and origins[0] != f"http://{hosts[0]}"):
        return f"from another page: {short(', '.join(origins))}"
    return None


def decoded(raw: Any) -> Any:
    """A client's message as plain values; None for what is none."""
    import msgspec.msgpack

    try:
        return msgspec.msgpack.decode(raw) if isinstance(raw, bytes) else None
    except (ValueError, RecursionError):
        return None


def short(value: Any) -> str:
    """A value in at most 100 printable characters."""
    text = ascii(value)
    return text if len(text) <= 100 else f"{text[:97]}..."
