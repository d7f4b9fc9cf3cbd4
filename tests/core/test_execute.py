"""Chunked work: it can be cancelled between its chunks, and within one that takes long."""

from __future__ import annotations

import platform
import subprocess
import sys
import threading
import time

import pytest

from refine_addon.core.execute import Cancelled, checkpoint, chunks, run_all

LONG = 600.0  # seconds; a tenth of it is more than any machine needs to notice


def endless(_piece: slice) -> None:
    """Work until cancelled."""
    end = time.monotonic() + LONG
    while time.monotonic() < end:
        time.sleep(0.001)
        checkpoint()


@pytest.mark.parametrize("threads", [1, 2])
def test_work_that_takes_long_is_cancelled_within_a_chunk(threads):
    """The first report begins the work, the second comes while it runs: it stops there."""
    calls = iter(range(100))
    start = time.monotonic()

    with pytest.raises(Cancelled):
        run_all(endless, chunks(2, 1), progress=lambda _fraction, _what: next(calls) < 1,
                   threads=threads)  # fmt: skip

    assert time.monotonic() - start < LONG / 10


@pytest.mark.parametrize("threads", [1, 2])
def test_work_within_a_chunk_is_cancelled_between_its_own_chunks(threads):
    """Each consists of a hundred, of which nobody is told; the second report stops them."""
    calls = iter(range(100))
    begun = []

    def within(_piece: slice) -> None:
        run_all(
            lambda piece: begun.append(piece.start) or time.sleep(0.05), chunks(100, 1), threads=1
        )

    with pytest.raises(Cancelled):
        run_all(within, chunks(2, 1), progress=lambda _fraction, _what: next(calls) < 1,
                   threads=threads)  # fmt: skip

    assert len(begun) < 100


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_stops_the_chunks_that_run(threads):
    """The first chunk fails while the second runs; nothing waits for the end of that one."""
    running = threading.Event()

    def work(piece: slice) -> None:
        if piece.start:
            running.set()
            endless(piece)
        elif threads > 1:
            running.wait()
        raise ValueError("broken")

    start = time.monotonic()

    with pytest.raises(ValueError, match="broken"):
        run_all(work, chunks(2, 1), threads=threads)

    assert time.monotonic() - start < LONG / 10


@pytest.mark.parametrize("threads", [1, 2])
def test_after_the_work_nothing_is_left_to_cancel(threads):
    """A checkpoint outside of chunked work does nothing, though the last work was cancelled."""
    with pytest.raises(Cancelled):
        run_all(endless, chunks(2, 1), progress=lambda *_: False, threads=threads)

    checkpoint()


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_the_order_of_the_slices(threads):
    """Whatever the number of threads; the last slice is what is left."""
    found = run_all(lambda piece: (piece.start, piece.stop), chunks(10, 4), threads=threads)

    assert found == [(0, 4), (4, 8), (8, 10)]


IN_A_THREAD = """
import ctypes, threading
from refine_addon.core.execute import share_heap
if {share}:
    share_heap()
libc, found = ctypes.CDLL(None), []
libc.malloc.restype = ctypes.c_size_t
thread = threading.Thread(target=lambda: found.append(libc.malloc(2000)))
thread.start()
thread.join()
with open("/proc/self/maps") as maps:
    heap = next(line for line in maps if "[heap]" in line).split()[0]
start, end = (int(each, 16) for each in heap.split("-"))
print(start <= found[0] < end)
"""


@pytest.mark.skipif(
    sys.platform != "linux" or platform.libc_ver()[0] != "glibc", reason="only glibc has heaps"
)
@pytest.mark.parametrize("share", [False, True])
def test_threads_of_the_command_allocate_from_its_one_heap(share):
    """A heap of their own would keep what they freed."""
    code = IN_A_THREAD.format(share=share)
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert told.stdout.strip() == str(share)
