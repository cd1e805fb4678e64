"""What goes wrong at the Hub: one line that says what to do, and no token in anything that is printed, logged or
raised.
"""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from playslot_rl.errors import DEBUG, HubError, PlaySlotError
from playslot_rl.storage.atomic import write_error
from playslot_rl.storage.secrets import mask, masked_logs

LOG_IN = "run `hf auth login` once, or set HF_TOKEN"
AGAIN = "run the same command again"


@dataclass(frozen=True)
class Asked:
    """What is asked of the Hub, as messages speak of it: `user/name`, or an address as it was typed; `data set` or
    `model`; the Hub's address; a local folder; the revision, if one was given; whether it is a push; whether a token is
    sent."""

    name: str
    what: str
    endpoint: str
    root: Path
    revision: str
    writing: bool
    has_token: bool


@contextlib.contextmanager
def one_line(asked: Asked, token: str | None, kind: type[PlaySlotError] = HubError) -> Iterator[None]:
    """Say what goes wrong inside in one line without the token; the error goes along as a note that is masked, too.

    Raises:
        PlaySlotError: of the `kind`, for an error of the Hub or its client; another one from inside, without the token.
    """
    try:
        with masked_logs(token):
            yield
        return
    except Exception as error:  # noqa: BLE001 - nothing that may hold a token goes on as it is
        known = translate(error, asked, kind)
        failure = type(known)(mask(str(known), token))
        failure.add_note(mask("".join(traceback.format_exception(error)), token))
    # A server may repeat the token it was sent, and the client's errors hold its answer: they do not go along.
    try:
        raise failure
    finally:
        failure.__context__ = None


def translate(error: BaseException, asked: Asked, kind: type[PlaySlotError] = HubError) -> PlaySlotError:
    """One line about an error of the Hub's client.

    The error itself is looked at first, then what caused it: uploads and downloads wrap the errors of their threads.
    """
    link: BaseException | None = error
    while link is not None:
        if isinstance(link, PlaySlotError):
            return link
        said = _said(link, asked)
        if said is not None:
            return kind(said)
        unwritten = write_error(asked.root, link)
        if unwritten is not None:
            return unwritten
        link = link.__cause__ or link.__context__
    doing = "push" if asked.writing else "pull"
    return kind(
        f"{asked.name}: got {type(error).__name__}: {' '.join(str(error).split())} (unexpected; {DEBUG}=1 shows "
        f"where), expected the {doing} to go on"
    )


def _said(error: BaseException, asked: Asked) -> str | None:
    """What an error means; None if it is none of the client's."""
    import httpx
    from huggingface_hub import errors

    match error:
        case errors.OfflineModeIsEnabled():
            said = f"offline mode (HF_HUB_OFFLINE is set), expected access to the Hub: unset HF_HUB_OFFLINE and {AGAIN}"
        case errors.LocalTokenNotFoundError():
            said = f"no token, expected one with write access to push: {LOG_IN}"
        case errors.HfHubHTTPError():
            said = _answered(error, asked)
        case errors.HFValidationError() | errors.HfUriError():
            return (
                f"got the {asked.what} name {asked.name!r}, expected user/name of letters, digits, '-', '_' and '.': "
                f"your name on the Hub, a slash, and a name for the {asked.what}"
            )
        case httpx.UnsupportedProtocol() | httpx.InvalidURL():
            return f"got HF_ENDPOINT={asked.endpoint}, expected the address of a Hub: unset HF_ENDPOINT or mend it"
        case httpx.TransportError() | ConnectionError() | TimeoutError():
            said = (
                f"no connection to {asked.endpoint} ({type(error).__name__}), expected the network: check it and "
                f"{AGAIN}, it carries on"
            )
        case _ if "xet" in f"{type(error).__module__}.{type(error).__name__}".lower():
            said = (
                f"a failed transfer ({error}), expected the files to be moved: {AGAIN}, with HF_HUB_DISABLE_XET=1 if "
                "it fails again"
            )
        case _:
            return None
    return f"{asked.name}: got {said}"


def _answered(error: BaseException, asked: Asked) -> str:
    """What an answer of the Hub with an error status means."""
    from huggingface_hub import errors

    status = int(error.response.status_code)  # type: ignore[attr-defined]
    if isinstance(error, errors.RevisionNotFoundError):
        return (
            f"no revision {asked.revision or 'main'!r}, expected a branch, a tag or a commit: see its page on the Hub, "
            "or leave the revision out"
        )
    if isinstance(error, errors.GatedRepoError):
        return f"a gated {asked.what}, expected access to it: ask for access on its page, then {LOG_IN}"
    if status == 401 and asked.has_token and not isinstance(error, errors.RepositoryNotFoundError):
        return (
            "401, a bad token (invalid or expired), expected a valid one: make a new one in the Hub's "
            f"settings/tokens, then {LOG_IN}"
        )
    if status in (401, 404):
        # 401 also stands for a repository that is not there, for those who sent no token.
        who = "your token" if asked.has_token else "you: no token was sent"
        private = "" if asked.has_token else f"; if it is private, {LOG_IN}"
        return (
            f"no such {asked.what} on {asked.endpoint}, or one hidden from {who}; expected user/name of a "
            f"{asked.what}: check the name{private}"
        )
    if status == 403:
        return (
            f"403, the token may not {'write to' if asked.writing else 'read'} it; expected one with that right: check "
            "the owner's name, and the token's rights in the Hub's settings/tokens"
        )
    if status == 412:
        return f"another push in between, expected to be the only one: {AGAIN}"
    if status == 429:
        return f"429, too many requests, expected fewer: {AGAIN} in some minutes"
    if status >= 500:
        return (
            f"{status}, an error of the Hub's own, also after retries; expected an answer: {AGAIN} later, it carries on"
        )
    reason = " ".join(str(getattr(error, "server_message", None) or error).split())[:300]
    return f"{status} from the Hub ({reason}), expected the request to be taken"
