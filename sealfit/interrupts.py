"""Signals that end a process, held back while half of what it does would be worse than none."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def undisturbed(by: signal.Signals = signal.SIGINT) -> Iterator[None]:
    """Let a Ctrl-C, or another signal that Python hears, wait until the block has ended."""
    before = signal.getsignal(by)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield  # signals reach the main thread only, and this one is not heard
        return
    waiting: list[object] = []
    signal.signal(by, lambda *caught: waiting.append(caught))
    try:
        yield
    finally:
        signal.signal(by, before)
        if waiting:
            signal.raise_signal(by)
