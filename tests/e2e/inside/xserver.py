"""Press a key as a person's keyboard does, by the X server: renders end at no simulated Esc."""

from __future__ import annotations

import os
import socket
import struct
from pathlib import Path

ESCAPE = 9
_PRESSED, _RELEASED = 2, 3


def tap(keycode):
    """Press and release a key, by the extension XTEST."""
    with socket.socket(socket.AF_UNIX) as stream:
        number = os.environ["DISPLAY"].partition(":")[2].partition(".")[0]
        stream.connect(f"/tmp/.X11-unix/X{number}")
        # The password of the server: of the last entry of the file, its last field.
        name, cookie = b"MIT-MAGIC-COOKIE-1", Path(os.environ["XAUTHORITY"]).read_bytes()[-16:]
        hello = struct.pack("<BxHHHHxx", ord("l"), 11, 0, len(name), len(cookie))
        stream.sendall(hello + _padded(name) + cookie)
        (length,) = struct.unpack("<6xH", _received(stream, 8))
        _received(stream, 4 * length)
        name = b"XTEST"
        _tell(stream, 98, 0, struct.pack("<Hxx", len(name)) + _padded(name))  # QueryExtension
        opcode = _answer(stream)[9]
        for kind in (_PRESSED, _RELEASED):
            _tell(stream, opcode, 2, struct.pack("<BBxxI24x", kind, keycode, 0))  # FakeInput
        _tell(stream, 43, 0, b"")  # GetInputFocus: wait for its answer
        _answer(stream)


def _tell(stream, opcode, detail, body):
    stream.sendall(struct.pack("<BBH", opcode, detail, 1 + len(body) // 4) + body)


def _answer(stream):
    while (packet := _received(stream, 32))[0] != 1:  # the keyboard's events
        if packet[0] == 0:
            raise OSError(f"X error {packet[1]} of request {packet[10]}")
    return packet


def _received(stream, count):
    data = stream.recv(count, socket.MSG_WAITALL)
    if len(data) < count:
        raise ConnectionError(data)
    return data


def _padded(text):
    return text + bytes(-len(text) % 4)
