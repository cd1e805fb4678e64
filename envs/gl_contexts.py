"""EGL contexts that are kept for the next renderer of the process.

A context compiles what it draws with, and what shrinks a texture, when it first needs it: in software 0.2 to 0.3 s a
context, more than loading a task. An environment that is closed leaves its context to the next one that is made.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import threading
from collections.abc import Iterator
from typing import Any, Final

from playslot_rl.errors import RenderError

KEPT: Final = 8
"""Contexts kept at most; those that are closed beyond it are freed."""

_free: list[tuple[int, Any]] = []
"""Process and context: a forked process cannot use what its parent made."""
_begun: list[int] = []
"""The process that made the first context, where there is one."""
_choosing = threading.Lock()

FORKED: Final = (
    "drawing: got a process that was forked from one that draws, expected one of its own: start it by `forkserver` or "
    '`spawn` (gymnasium.make_vec: vector_kwargs={"context": "forkserver"})'
)


class KeptContext:
    """An EGL context as MuJoCo's renderers use it; freed, it waits for the next one. What is drawn into lies in the
    context, whatever its size. A RenderError in a process that was forked from one that draws."""

    def __init__(self, width: int, height: int) -> None:
        self._context: Any = _take()
        if self._context is None:
            from mujoco.egl import GLContext

            if _begun and _begun[0] != os.getpid():
                raise RenderError(FORKED)  # asked for a context, the driver would wait for its threads for ever
            self._context = GLContext(width, height)
            _begun[:] = [os.getpid()]
            _end_at_exit()

    def make_current(self) -> None:
        """Draw in it from now on, in this thread; a RuntimeError where another thread does."""
        _enter(self._context)

    def free(self) -> None:
        """Leave it to the next; safe to call twice."""
        context, self._context = self._context, None
        if context is not None:
            _give_back(context)


@contextlib.contextmanager
def kept_contexts() -> Iterator[None]:
    """A renderer made within draws in a kept context where MuJoCo draws by EGL; other renderers are left alone."""
    from mujoco import gl_context

    if os.environ.get("MUJOCO_GL") != "egl":
        yield
        return
    with _choosing:
        before, gl_context.GLContext = gl_context.GLContext, KeptContext
        try:
            yield
        finally:
            gl_context.GLContext = before


def _take() -> Any:
    with contextlib.suppress(IndexError):
        while True:  # pop is atomic, so that threads get one each
            process, context = _free.pop()
            if process == os.getpid():
                return context
    return None


def _enter(context: Any) -> None:
    from OpenGL.error import Error

    try:
        context.make_current()
    except Error as error:
        raise RuntimeError("the GL context: got a call while another thread draws in it, expected one") from error


def _give_back(context: Any) -> None:
    from mujoco.egl import EGL

    if len(_free) < KEPT:
        with contextlib.suppress(RuntimeError):
            _enter(context)
            EGL.eglReleaseThread()
            _free.append((os.getpid(), context))
            return
    context.free()


@functools.cache
def _end_at_exit() -> None:
    """Once, after the first context: handlers run last in, first out. MuJoCo ends EGL in one that its first context has
    registered, and each renderer gives its context back in one that is registered later.
    """
    atexit.register(_end)


def _end() -> None:
    for process, context in _free:
        if process == os.getpid():
            context.free()
    _free.clear()
