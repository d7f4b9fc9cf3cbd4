"""Talk to the X server as a person's keyboard and file manager do: a key press, a dropped file.

Blender's renders end at no simulated Esc, and no operator drops a zip.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import time

ESCAPE = 9

_PATIENCE = 20.0  # seconds
_PRESSED, _RELEASED = 2, 3
_SELECTION_REQUEST, _SELECTION_NOTIFY, _CLIENT_MESSAGE = 30, 31, 33
_VERSION = 5


def tap(keycode: int) -> None:
    """Press and release a key, by the extension XTEST."""
    with socket.socket(socket.AF_UNIX) as stream:
        server = _Server(stream)
        name = b"XTEST"
        opcode = server.ask(98, 0, struct.pack("<Hxx", len(name)) + name)[9]  # QueryExtension
        for kind in (_PRESSED, _RELEASED):
            server.tell(opcode, 2, struct.pack("<BBxxI24x", kind, keycode, 0))  # FakeInput
        server.ask(43, 0, b"")  # GetInputFocus: wait for its answer


def drop(path: str, x: int, y: int) -> None:
    """Drop a file on the window below a place of the screen, y from the top, by Xdnd.

    To be called on a thread: the window answers as it handles its events.

    Raises
    ------
    TimeoutError
        If the window does not take it.
    """
    with socket.socket(socket.AF_UNIX) as stream:
        _Dropping(_Server(stream), f"file://{path}\r\n".encode()).drop(x, y)


class _Dropping:
    """A window that nobody sees, from which a file is dragged."""

    def __init__(self, server: _Server, uris: bytes) -> None:
        self.server, self.uris = server, uris
        self.atoms = {
            name: server.atom(name)
            for name in (
                *("XdndAware", "XdndEnter", "XdndPosition", "XdndStatus", "XdndDrop"),
                *("XdndFinished", "XdndSelection", "XdndActionCopy", "text/uri-list"),
            )
        }
        self.window = server.first_id
        place = struct.pack("<IIhhHHHHII", self.window, server.root, 0, 0, 1, 1, 0, 0, 0, 0)
        server.tell(1, 0, place)  # CreateWindow

    def drop(self, x: int, y: int) -> None:
        """Enter the window there, ask whether it takes the file, and leave it there."""
        server, atoms = self.server, self.atoms
        selection = struct.pack("<III", self.window, atoms["XdndSelection"], 0)
        server.tell(22, 0, selection)  # SetSelectionOwner
        place = struct.pack("<IIhhHHhh", 0, server.root, 0, 0, 0, 0, x, y)
        server.tell(41, 0, place)  # WarpPointer
        target = self._below(server.root)
        self._say(target, "XdndEnter", _VERSION << 24, atoms["text/uri-list"], 0, 0)
        for _ in range(3):
            self._say(target, "XdndPosition", 0, x << 16 | y, 0, atoms["XdndActionCopy"])
            self._until("XdndStatus")
        self._say(target, "XdndDrop", 0, 0, 0, 0)
        self._until("XdndFinished")

    def _below(self, window: int) -> int:
        """Return the first window that takes files, from the top."""
        answer = self.server.ask(15, 0, struct.pack("<I", window))  # QueryTree
        (count,) = struct.unpack_from("<H", answer, 16)
        children = struct.unpack_from(f"<{count}I", answer, 32)
        for child in reversed(children):
            asked = struct.pack("<IIIII", child, self.atoms["XdndAware"], 0, 0, 1)
            if self.server.ask(20, 0, asked)[1]:  # GetProperty: its format
                return child
            if found := self._below(child):
                return found
        return 0

    def _say(self, target: int, kind: str, *values: int) -> None:
        event = struct.pack(
            "<BBHIIIIIII", _CLIENT_MESSAGE, 32, 0, target, self.atoms[kind], self.window, *values
        )
        self.server.tell(25, 0, struct.pack("<II", target, 0) + event)  # SendEvent

    def _until(self, kind: str) -> None:
        """Wait for a message, and hand out the name of the file meanwhile."""
        end = time.monotonic() + _PATIENCE
        while True:
            event = self.server.event(end - time.monotonic())
            code = event[0] & 0x7F
            if code == _SELECTION_REQUEST:
                self._hand_out(event)
            elif code == _CLIENT_MESSAGE and self.atoms[kind] in struct.unpack_from("<I", event, 8):
                return

    def _hand_out(self, event: bytes) -> None:
        moment, _, requestor, selection, target, name = struct.unpack_from("<IIIIII", event, 4)
        name = name or target
        value = struct.pack("<IIIBxxxI", requestor, name, target, 8, len(self.uris)) + self.uris
        self.server.tell(18, 0, value)  # ChangeProperty
        told = struct.pack(
            "<BxHIIIII8x", _SELECTION_NOTIFY, 0, moment, requestor, selection, target, name
        )
        self.server.tell(25, 0, struct.pack("<II", requestor, 0) + told)  # SendEvent


class _Server:
    """A connection to the X server, by its protocol."""

    def __init__(self, stream: socket.socket) -> None:
        self.stream, self.events = stream, []
        number = os.environ["DISPLAY"].partition(":")[2].partition(".")[0]
        stream.connect(f"/tmp/.X11-unix/X{number}")
        name, cookie = b"MIT-MAGIC-COOKIE-1", _cookie()
        hello = struct.pack("<BxHHHHxx", ord("l"), 11, 0, len(name), len(cookie))
        stream.sendall(hello + _padded(name) + _padded(cookie))
        (length,) = struct.unpack("<6xH", self._received(8))
        setup = self._received(4 * length)
        self.first_id, vendor, formats = (
            struct.unpack_from(kind, setup, at)[0]
            for kind, at in (("<I", 4), ("<H", 16), ("<B", 21))
        )
        (self.root,) = struct.unpack_from("<I", setup, 32 + vendor + -vendor % 4 + 8 * formats)

    def tell(self, opcode: int, detail: int, body: bytes) -> None:
        """Send a request that has no answer."""
        body = _padded(body)
        self.stream.sendall(struct.pack("<BBH", opcode, detail, 1 + len(body) // 4) + body)

    def ask(self, opcode: int, detail: int, body: bytes) -> bytes:
        """Send a request; return its answer."""
        self.tell(opcode, detail, body)
        while True:
            packet = self._packet()
            if packet[0] == 1:
                return packet
            self.events.append(packet)

    def atom(self, name: str) -> int:
        """Return the server's number for a name."""
        text = name.encode()
        answer = self.ask(16, 0, struct.pack("<Hxx", len(text)) + text)  # InternAtom
        return int(struct.unpack_from("<I", answer, 8)[0])

    def event(self, patience: float) -> bytes:
        """Return the next event, waiting for it."""
        if self.events:
            return self.events.pop(0)
        if not select.select([self.stream], [], [], max(0.0, patience))[0]:
            raise TimeoutError("the window does not answer")
        return self._packet()

    def _packet(self) -> bytes:
        """Receive an answer or an event."""
        packet = self._received(32)
        if packet[0] == 0:
            raise OSError(f"X error {packet[1]} of request {packet[10]}")
        if packet[0] == 1:
            (length,) = struct.unpack_from("<I", packet, 4)
            packet += self._received(4 * length)
        return packet

    def _received(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            piece = self.stream.recv(count - len(data))
            if not piece:
                raise ConnectionError(data)
            data += piece
        return data


def _cookie() -> bytes:
    """Return the password of the server: of the last entry of the file, its last field."""
    with open(os.environ["XAUTHORITY"], "rb") as stream:
        return stream.read()[-16:]


def _padded(text: bytes) -> bytes:
    return text + bytes(-len(text) % 4)
