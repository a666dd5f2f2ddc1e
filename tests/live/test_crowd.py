"""A crowd at the live page: hostile, deaf, rude and ordinary clients at once, through the real command line.

`CROWD=100 MINUTES=15` makes it larger and longer: `CROWD=100 MINUTES=15 pytest -s tests/live/test_crowd.py`.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import re
import signal
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

viser = pytest.importorskip("viser", reason="needs the extra view")

import msgspec.msgpack  # noqa: E402
from websockets.asyncio.client import connect  # noqa: E402
from websockets.exceptions import WebSocketException  # noqa: E402

from forks import Fork  # noqa: E402
from franka_wm.commands import main as cli  # noqa: E402

pytestmark = pytest.mark.slow

CLIENTS = int(os.environ.get("CROWD", 20))
SECONDS = 60 * float(os.environ.get("MINUTES", 0.2))
GROWTH = 50e6
"""Memory that the server may take beyond what it has with its first reader [bytes]."""
ENDS_WITHIN = 2.0
"""From Ctrl-C to the end of the process [s]."""

PROTOCOL = f"viser-v{viser.__version__}"  # pyright: ignore
GONE = (OSError, WebSocketException, asyncio.TimeoutError, EOFError)
ODD: list[Any] = [
    5_000_000, -1, 0, 10**18, 1e300, float("nan"), float("inf"), "x" * 9_000, None, [], {}, [1e300] * 3, True,
    [float("nan")] * 4, {"removed": True}, [[[]]], "__class__",
]  # fmt: skip
KINDS = [
    "GuiUpdateMessage", "TransformControlsUpdateMessage", "TransformControlsDragStartMessage", "ViewerCameraMessage",
    "RunJavascriptMessage", "RemoveSceneNodeMessage", "GuiCloseModalMessage", "ShareUrlRequest", "ShareUrlDisconnect",
    "FileTransferStartUpload", "FileTransferPart", "SceneNodeClickMessage", "GetRenderResponseMessage", "nothing", 7,
]  # fmt: skip


class Crowd:
    """Clients of one page, each of one habit, until the time is up."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.counts: Counter[str] = Counter()
        self.controls: set[str] = set()
        self.random = random.Random(0)

    async def gather(self, clients: int, seconds: float, pid: int) -> list[int]:
        """Returns the memory of the page's process, eight times on the way [bytes]."""
        habits = [self.reads, self.sends, self.sends, self.is_deaf, self.comes_and_goes, self.knocks]
        async with asyncio.timeout(seconds + 60):
            self.ends = time.monotonic() + seconds
            everyone = asyncio.gather(*(self.insists(habits[k % len(habits)]) for k in range(clients)))
            memory = []
            for _ in range(8):
                await asyncio.sleep(seconds / 8.5)
                memory.append(resident(pid))
            await everyone
            return memory

    async def insists(self, habit: Any) -> None:
        while time.monotonic() < self.ends:
            try:
                await habit()
            except GONE:
                self.counts["turned away"] += 1
                await asyncio.sleep(0.2)

    def connect(self, **more: Any) -> Any:
        return connect(
            f"ws://127.0.0.1:{self.port}", subprotocols=[PROTOCOL], max_size=None, open_timeout=30, **more
        )

    async def reads(self) -> None:
        """An ordinary client, which only looks; it notes the names of the controls for the others."""
        async with self.connect() as socket:
            while time.monotonic() < self.ends:
                raw = await asyncio.wait_for(socket.recv(), 30)
                self.counts["heard"] += 1
                self.controls.update(one.decode() for one in re.findall(rb"[0-9a-f]{8}-[0-9a-f-]{27}", raw))

    async def sends(self) -> None:
        """Sends what no page sends, and drags the goal about."""
        async with self.connect() as socket:
            listening = asyncio.create_task(self.drains(socket))
            try:
                while time.monotonic() < self.ends:
                    message = self.hostile()
                    self.counts["hostile"] += 1
                    await socket.send(message)
                    await asyncio.sleep(0.01)
            finally:
                listening.cancel()

    @staticmethod
    async def drains(socket: Any) -> None:
        with contextlib.suppress(*GONE):
            async for _ in socket:
                pass

    async def is_deaf(self) -> None:
        """Never reads what is sent to it."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port, limit=1024)
        writer.write(self.handshake(PROTOCOL))
        await writer.drain()
        self.counts["deaf"] += 1
        while time.monotonic() < self.ends and not writer.is_closing():
            await asyncio.sleep(0.2)
        writer.close()
        del reader

    async def comes_and_goes(self) -> None:
        """Leaves in the middle of the first messages, or sends one that is too large."""
        async with self.connect() as socket:
            self.counts["visits"] += 1
            if self.random.random() < 0.3:
                await socket.send(b"\x00" * 200_000)
            if self.random.random() < 0.5:
                await socket.recv()
        await asyncio.sleep(0.05)

    async def knocks(self) -> None:
        """Half a handshake, no HTTP at all, another version, another site."""
        _, writer = await asyncio.open_connection("127.0.0.1", self.port)
        self.counts["knocks"] += 1
        writer.write(
            self.random.choice(
                [
                    b"GET / HTTP/1.1\r\nHost: 127.",
                    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc",
                    b"GET /" + b"x" * 20_000 + b" HTTP/1.1\r\n\r\n",
                    b"GET /../../../../etc/passwd HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
                    self.handshake("viser-v0.0.1"),
                    self.handshake(PROTOCOL, "https://evil.example"),
                    b"",
                ]
            )
        )
        await writer.drain()
        await asyncio.sleep(self.random.random())
        writer.close()

    def handshake(self, protocol: str, origin: str | None = None) -> bytes:
        lines = [
            "GET / HTTP/1.1", f"Host: 127.0.0.1:{self.port}", "Upgrade: websocket", "Connection: Upgrade",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Protocol: {protocol}", *([f"Origin: {origin}"] if origin else []),
        ]  # fmt: skip
        return "\r\n".join([*lines, "", ""]).encode()

    def hostile(self) -> bytes | str:
        draw = self.random
        if draw.random() < 0.1:
            return draw.randbytes(draw.randrange(300))
        if draw.random() < 0.05:
            return "text"
        uuid = draw.choice(sorted(self.controls) or ["nobody"])
        message: dict[Any, Any] = {"type": draw.choice(KINDS)}
        if draw.random() < 0.6:
            message |= {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": draw.choice(ODD)}}
            if draw.random() < 0.3:
                message["updates"] = {draw.choice(["removed", "value", "min", "x"]): draw.choice(ODD)}
        for name in draw.sample(["name", "position", "wxyz", "fov", "uuid", "size_bytes", "owner"], 3):
            message[name] = draw.choice(["/goal", "/arm", *ODD])
        with contextlib.suppress(OverflowError):
            return msgspec.msgpack.encode(message)
        return b"\xc1"


def resident(pid: int) -> int:
    """Memory of a process [bytes]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_a_crowd_neither_ends_nor_fills_the_page(tmp_path: Path) -> None:
    fork = Fork(
        lambda: cli.main(["view", "port=0", "device=cpu", "env.substeps=2"]), tmp_path, tmp_path / "log"
    )
    try:
        address = found_address(fork)
        warm = Crowd(address)
        asyncio.run(warm.gather(2, 3.0, fork.pid))
        before, threads = resident(fork.pid), len(os.listdir(f"/proc/{fork.pid}/task"))
        crowd = Crowd(address)
        memory = asyncio.run(crowd.gather(CLIENTS, SECONDS, fork.pid))
        after = Crowd(address)
        for _ in range(15):  # a busy machine takes its time to forget a hundred clients
            asyncio.run(after.gather(1, 2.0, fork.pid))
            if after.counts["heard"] > 1:
                break
        assert after.counts["heard"] > 1, "nobody is heard any more"
        time.sleep(1.0)
        grown = resident(fork.pid) - before
        more_threads = len(os.listdir(f"/proc/{fork.pid}/task")) - threads
        descriptors = len(os.listdir(f"/proc/{fork.pid}/fd"))
    finally:
        os.kill(fork.pid, signal.SIGINT)
        began = time.monotonic()
        ended = fork.wait(30)
    took = time.monotonic() - began
    print(
        f"{CLIENTS} clients, {SECONDS:.0f} s, {dict(crowd.counts)}: {grown / 1e6:.1f} MB more "
        f"(on the way {[round((m - before) / 1e6) for m in memory]}), {more_threads} threads more, {descriptors} "
        f"descriptors, ended {took:.2f} s after Ctrl-C, {len(ended.stderr) + len(ended.stdout)} characters said"
    )
    assert crowd.counts["hostile"] >= 1000
    assert max(grown, *(m - before for m in memory)) < GROWTH
    assert took < ENDS_WITHIN
    assert "Traceback" not in ended.stderr + ended.stdout, ended.stderr
    lines = (ended.stderr + ended.stdout).count("\n")
    assert lines < 20 + 2 * SECONDS, f"{lines} lines, one a second at most: {ended.stdout[-2000:]}"


def found_address(fork: Fork) -> int:
    """The port that the command prints."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if match := re.search(r"http://127\.0\.0\.1:(\d+)", fork.said()[0]):
            return int(match[1])
        time.sleep(0.1)
    raise AssertionError(fork.said())
