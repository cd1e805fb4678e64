"""Keeping a token out of everything that is printed, logged or raised."""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from playslot_rl.errors import HubError

MASK = "<token>"
_SHAPED = re.compile(r"\bhf_[A-Za-z0-9]{16,}\b")
_BEARER = re.compile(r"(?i)\b(bearer|basic)(\s+|%20)[^\s'\",;]+")
_IN_ADDRESS = re.compile(r"(?<=://)[^/\s@'\"]+@")
_CHARACTERS = re.compile(r"[A-Za-z0-9._~+/=-]+")


def checked_token(token: str | None) -> str | None:
    """A token as it can be sent: stripped, and of characters that stand for themselves in every message.

    Raises:
        HubError: it has spaces, line breaks or other characters inside; a library would print it in its complaint.
    """
    token = (token or "").strip()
    if token and not _CHARACTERS.fullmatch(token):
        raise HubError(
            "bad token: got one with characters that no token has (a space or a line break?), expected hf_ and letters "
            "and digits: copy it again from the Hub's settings/tokens"
        )
    return token or None


@dataclass(frozen=True)
class Redactor:
    """Replaces tokens in texts, errors and log records.

    Attributes:
        token: the one in use; anything shaped like a token is replaced as well.
    """

    token: str | None = field(default=None, repr=False)

    def text(self, text: str) -> str:
        """`text` without tokens."""
        if self.token:
            text = text.replace(self.token, MASK)
        text = _SHAPED.sub(MASK, text)
        return _IN_ADDRESS.sub(f"{MASK}@", _BEARER.sub(rf"\1\2{MASK}", text))

    def error(self, error: BaseException) -> None:
        """Clean an error in place, with its causes and contexts: servers may repeat what they were sent."""
        for link in chain(error):
            link.args = tuple(self._value(arg) for arg in link.args)
            for name, value in vars(link).items():
                with contextlib.suppress(AttributeError, TypeError):
                    setattr(link, name, self._value(value))

    def _value(self, value: Any) -> Any:
        if isinstance(value, str) and type(value) is str:
            return self.text(value)
        if isinstance(value, bytes):
            return self.text(value.decode("latin-1")).encode("latin-1")
        if isinstance(value, list | tuple) and type(value) in (list, tuple):
            return type(value)(self._value(item) for item in value)
        return value

    @contextlib.contextmanager
    def logs(self) -> Iterator[None]:
        """Clean every log record made inside, whatever its logger and level."""
        previous = logging.getLogRecordFactory()

        def make(*args: Any, **kwargs: Any) -> logging.LogRecord:
            record = previous(*args, **kwargs)
            record.msg, record.args = self.text(record.getMessage()), ()
            if record.exc_info and record.exc_info[1] is not None:
                self.error(record.exc_info[1])
            return record

        logging.setLogRecordFactory(make)
        try:
            yield
        finally:
            if logging.getLogRecordFactory() is make:
                logging.setLogRecordFactory(previous)


def chain(error: BaseException) -> Iterator[BaseException]:
    """An error, then what caused it, then what was being handled; each once."""
    waiting: list[BaseException | None] = [error]
    seen: set[int] = set()
    while waiting:
        link = waiting.pop(0)
        if link is None or id(link) in seen:
            continue
        seen.add(id(link))
        yield link
        waiting += [link.__cause__, link.__context__]
