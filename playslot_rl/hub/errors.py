"""What went wrong at the Hub, in one line that says what to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from playslot_rl.errors import HubError, OutputError, PlaySlotError
from playslot_rl.hub.secrets import chain
from playslot_rl.storage.atomic import explain_write_errors

LOG_IN = "run `hf auth login` once, or set HF_TOKEN"


@dataclass(frozen=True)
class Place:
    """What was being done, for the messages.

    Attributes:
        repo_id: the repository on the Hub, `user/name`.
        endpoint: address of the Hub.
        root: local folder.
        writing: a push (a pull otherwise).
        has_token: whether a token was sent.
        revision: the revision asked for; empty if none was.
        what: what the repository is, in words.
    """

    repo_id: str
    endpoint: str
    root: Path
    writing: bool
    has_token: bool
    revision: str = ""
    what: str = "data set"


def offline(place: Place) -> HubError:
    """Offline mode is on."""
    return HubError(
        f"{place.repo_id}: got offline mode (HF_HUB_OFFLINE is set), expected access to the Hub: unset HF_HUB_OFFLINE "
        "and run the same command again"
    )


def no_token(place: Place) -> HubError:
    """There is nothing to log in with."""
    return HubError(f"{place.repo_id}: got no token, expected one with write access to push: {LOG_IN}")


def translate(error: BaseException, place: Place) -> PlaySlotError | None:
    """One line about an error of the Hub's client; None if it is not known.

    The error itself is looked at first, then what caused it: uploads and downloads wrap the errors of their threads.
    """
    for link in chain(error):
        known = _one(link, place)
        if known is not None:
            return known
    return None


def _one(error: BaseException, place: Place) -> PlaySlotError | None:
    import httpx
    from huggingface_hub import errors as hub

    if isinstance(error, hub.OfflineModeIsEnabled):
        return offline(place)
    if isinstance(error, hub.LocalTokenNotFoundError):
        return no_token(place)
    if isinstance(error, hub.HfHubHTTPError):
        return _http(error, place)
    if isinstance(error, hub.HFValidationError | hub.HfUriError):
        return bad_name(place)
    if isinstance(error, httpx.UnsupportedProtocol | httpx.InvalidURL):
        return HubError(
            f"got HF_ENDPOINT={place.endpoint}, expected the address of a Hub: unset HF_ENDPOINT or mend it"
        )
    if isinstance(error, httpx.TransportError | ConnectionError | TimeoutError):
        return HubError(
            f"{place.repo_id}: got no connection to {place.endpoint} ({type(error).__name__}), expected the network: "
            "check it and run the same command again, it carries on"
        )
    if isinstance(error, OSError):
        return _disk(error, place.root)
    if "xet" in f"{type(error).__module__}.{type(error).__name__}".lower():
        return HubError(
            f"{place.repo_id}: got a failed transfer ({error}), expected the files to be moved: run the same command "
            "again, with HF_HUB_DISABLE_XET=1 if it fails again"
        )
    return None


def _disk(error: OSError, root: Path) -> PlaySlotError | None:
    try:
        with explain_write_errors(root):
            raise error
    except OutputError as known:
        return known
    except OSError:
        return None


def _http(error: BaseException, place: Place) -> HubError:
    from huggingface_hub import errors as hub

    status = int(error.response.status_code)  # type: ignore[attr-defined]
    if isinstance(error, hub.RevisionNotFoundError):
        return no_revision(place)
    if isinstance(error, hub.GatedRepoError):
        return HubError(
            f"{place.repo_id}: got a gated {place.what}, expected access to it: ask for access on its page, then "
            f"{LOG_IN}"
        )
    if status == 401:
        return _unauthorised(error, place)
    if status == 403:
        what = "write to it" if place.writing else "read it"
        return HubError(
            f"{place.repo_id}: got 403, the token may not {what}; expected one with that right: check the owner's "
            "name, and the token's rights in the Hub's settings/tokens"
        )
    if status == 404:
        return no_repository(place)
    if status == 412:
        return HubError(
            f"{place.repo_id}: got another push in between, expected to be the only one: run the same command again"
        )
    if status == 429:
        return HubError(
            f"{place.repo_id}: got 429, too many requests, expected fewer: run the same command again in some minutes"
        )
    if status >= 500:
        return HubError(
            f"{place.repo_id}: got {status}, an error of the Hub's own, also after retries; expected an answer: run "
            "the same command again later, it carries on"
        )
    said = " ".join(str(getattr(error, "server_message", None) or error).split())[:300]
    return HubError(f"{place.repo_id}: got {status} from the Hub ({said}), expected the request to be taken")


def _unauthorised(error: BaseException, place: Place) -> HubError:
    """401 stands for a bad token, and for a repository that is not there for those who sent none."""
    from huggingface_hub import errors as hub

    if place.has_token and not isinstance(error, hub.RepositoryNotFoundError):
        return HubError(
            f"{place.repo_id}: got 401, a bad token (invalid or expired), expected a valid one: make a new one in the "
            f"Hub's settings/tokens, then {LOG_IN}"
        )
    return no_repository(place)


def no_repository(place: Place) -> HubError:
    """Nothing of that name, or private."""
    who = "your token" if place.has_token else "you: no token was sent"
    return HubError(
        f"{place.repo_id}: got no such {place.what} on {place.endpoint}, or one hidden from {who}; expected user/name "
        f"of a {place.what}: check the name" + ("" if place.has_token else f"; if it is private, {LOG_IN}")
    )


def no_revision(place: Place) -> HubError:
    """The repository exists, the revision does not."""
    return HubError(
        f"{place.repo_id}: got no revision {place.revision or 'main'!r}, expected a branch, a tag or a commit: see its "
        "page on the Hub, or leave the revision out"
    )


def bad_name(place: Place) -> HubError:
    """Not `user/name`."""
    return HubError(
        f"got the {place.what} name {place.repo_id!r}, expected user/name of letters, digits, '-', '_' and '.': your "
        f"name on the Hub, a slash, and a name for the {place.what}"
    )
