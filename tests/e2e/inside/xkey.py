"""A real key press by the X server's XTEST extension: Blender's renders end at no simulated Esc."""

from __future__ import annotations

import os
import socket
import struct

ESCAPE = 9
_PRESSED, _RELEASED = 2, 3


def tap(keycode: int) -> None:
    """Press and release a key."""
    number = os.environ["DISPLAY"].partition(":")[2].partition(".")[0]
    with socket.socket(socket.AF_UNIX) as server:
        server.connect(f"/tmp/.X11-unix/X{number}")  # noqa: S108 - where X servers listen
        name, cookie = b"MIT-MAGIC-COOKIE-1", _cookie()
        hello = struct.pack("<BxHHHHxx", ord("l"), 11, 0, len(name), len(cookie))
        server.sendall(hello + _padded(name) + _padded(cookie))
        (length,) = struct.unpack("<6xH", _received(server, 8))
        _received(server, 4 * length)
        server.sendall(struct.pack("<BxHHxx", 98, 2 + 2, 5) + _padded(b"XTEST"))  # QueryExtension
        opcode = _received(server, 32)[9]
        for kind in (_PRESSED, _RELEASED):
            server.sendall(struct.pack("<BBHBBxxI24x", opcode, 2, 9, kind, keycode, 0))
        server.sendall(struct.pack("<BxH", 43, 1))  # GetInputFocus: wait for its answer
        _received(server, 32)


def _cookie() -> bytes:
    """Return the password of the server: of the last entry of the file, its last field."""
    with open(os.environ["XAUTHORITY"], "rb") as stream:  # noqa: PTH123
        return stream.read()[-16:]


def _padded(text: bytes) -> bytes:
    return text + bytes(-len(text) % 4)


def _received(server: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        piece = server.recv(count - len(data))
        if not piece:
            raise ConnectionError(data)
        data += piece
    return data
