"""Tokens of the Hub: as they can be sent, and out of everything that is printed, logged or raised."""

from __future__ import annotations

import contextlib
import copy
import logging
import re
from collections.abc import Iterator

from playslot_rl.errors import HubError

MASK = "<token>"
_SHAPED = re.compile(r"\bhf_[A-Za-z0-9]{16,}\b")
_BEARER = re.compile(r"(?i)\b(bearer|basic)(\s+|%20)[^\s'\",;]+")
_IN_ADDRESS = re.compile(r"(?<=://)[^/\s@'\"]+@")
_CHARACTERS = re.compile(r"[A-Za-z0-9._~+/=-]+")


def checked_token(token: str | None) -> str | None:
    """A token as it can be sent: stripped, and of characters that stand for themselves in every message; a HubError for
    others inside: a library would print it in its complaint.
    """
    token = (token or "").strip()
    if token and not _CHARACTERS.fullmatch(token):
        raise HubError(
            "bad token: got one with characters that no token has (a space or a line break?), expected hf_ and letters "
            "and digits: copy it again from the Hub's settings/tokens"
        )
    return token or None


def mask(text: str, token: str | None = None) -> str:
    """`text` without `token`, and without anything shaped like a token or a password."""
    if token:
        text = text.replace(token, MASK)
    text = _SHAPED.sub(MASK, text)
    return _IN_ADDRESS.sub(f"{MASK}@", _BEARER.sub(rf"\1\2{MASK}", text))


@contextlib.contextmanager
def masked_logs(token: str | None) -> Iterator[None]:
    """Mask what the handlers of the root and of the Hub's client write inside; the log records stay as they are."""

    def masked(record: logging.LogRecord) -> logging.LogRecord:
        shown = copy.copy(record)
        shown.msg, shown.args = mask(record.getMessage(), token), ()
        if record.exc_info:
            shown.exc_info, text = None, logging.Formatter().formatException(record.exc_info)
            shown.exc_text = mask(text, token)
        return shown

    handlers = [*logging.getLogger().handlers, *logging.getLogger("huggingface_hub").handlers]
    for handler in handlers:
        handler.addFilter(masked)
    try:
        yield
    finally:
        for handler in handlers:
            handler.removeFilter(masked)
