"""What went wrong at the Hub, in one line that says what to do, and without a token in anything that is printed, logged
or raised.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.errors import DEBUG, HubError, OutputError, PlaySlotError
from playslot_rl.storage.atomic import explain_write_errors

if TYPE_CHECKING:
    from playslot_rl.hub.session import Repository

LOG_IN = "run `hf auth login` once, or set HF_TOKEN"


def translate(error: BaseException, hub: Repository) -> PlaySlotError:
    """One line about an error of the Hub's client.

    The error itself is looked at first, then what caused it: uploads and downloads wrap the errors of their threads.
    """
    link: BaseException | None = error
    while link is not None:
        known = _one(link, hub)
        if known is not None:
            return known
        link = link.__cause__ or link.__context__
    return HubError(
        f"{hub.name}: got {type(error).__name__}: {' '.join(str(error).split())} (unexpected; {DEBUG}=1 shows "
        f"where), expected the {'push' if hub.writing else 'pull'} to go on"
    )


def _one(error: BaseException, hub: Repository) -> PlaySlotError | None:
    import httpx
    from huggingface_hub import errors

    name = hub.name
    if isinstance(error, PlaySlotError):
        return error
    if isinstance(error, errors.OfflineModeIsEnabled):
        return HubError(
            f"{name}: got offline mode (HF_HUB_OFFLINE is set), expected access to the Hub: unset HF_HUB_OFFLINE and "
            "run the same command again"
        )
    if isinstance(error, errors.LocalTokenNotFoundError):
        return HubError(f"{name}: got no token, expected one with write access to push: {LOG_IN}")
    if isinstance(error, errors.HfHubHTTPError):
        return _http(error, hub)
    if isinstance(error, errors.HFValidationError | errors.HfUriError):
        return HubError(
            f"got the {hub.what} name {name!r}, expected user/name of letters, digits, '-', '_' and '.': your name "
            f"on the Hub, a slash, and a name for the {hub.what}"
        )
    if isinstance(error, httpx.UnsupportedProtocol | httpx.InvalidURL):
        return HubError(f"got HF_ENDPOINT={hub.endpoint}, expected the address of a Hub: unset HF_ENDPOINT or mend it")
    if isinstance(error, httpx.TransportError | ConnectionError | TimeoutError):
        return HubError(
            f"{name}: got no connection to {hub.endpoint} ({type(error).__name__}), expected the network: check it "
            "and run the same command again, it carries on"
        )
    if isinstance(error, OSError):
        return _disk(error, hub.root)
    if "xet" in f"{type(error).__module__}.{type(error).__name__}".lower():
        return HubError(
            f"{name}: got a failed transfer ({error}), expected the files to be moved: run the same command again, "
            "with HF_HUB_DISABLE_XET=1 if it fails again"
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


def _http(error: BaseException, hub: Repository) -> HubError:
    from huggingface_hub import errors

    status = int(error.response.status_code)  # type: ignore[attr-defined]
    if isinstance(error, errors.RevisionNotFoundError):
        said = (
            f"no revision {hub.revision or 'main'!r}, expected a branch, a tag or a commit: see its page on the Hub, "
            "or leave the revision out"
        )
    elif isinstance(error, errors.GatedRepoError):
        said = f"a gated {hub.what}, expected access to it: ask for access on its page, then {LOG_IN}"
    elif status == 401 and hub.has_token and not isinstance(error, errors.RepositoryNotFoundError):
        said = (
            "401, a bad token (invalid or expired), expected a valid one: make a new one in the Hub's "
            f"settings/tokens, then {LOG_IN}"
        )
    elif status in (401, 404):
        # 401 also stands for a repository that is not there, for those who sent no token.
        who = "your token" if hub.has_token else "you: no token was sent"
        said = (
            f"no such {hub.what} on {hub.endpoint}, or one hidden from {who}; expected user/name of a {hub.what}:"
            " check the name" + ("" if hub.has_token else f"; if it is private, {LOG_IN}")
        )
    elif status == 403:
        said = (
            f"403, the token may not {'write to' if hub.writing else 'read'} it; expected one with that right: check "
            "the owner's name, and the token's rights in the Hub's settings/tokens"
        )
    elif status == 412:
        said = "another push in between, expected to be the only one: run the same command again"
    elif status == 429:
        said = "429, too many requests, expected fewer: run the same command again in some minutes"
    elif status >= 500:
        said = (
            f"{status}, an error of the Hub's own, also after retries; expected an answer: run the same command again "
            "later, it carries on"
        )
    else:
        reason = " ".join(str(getattr(error, "server_message", None) or error).split())[:300]
        said = f"{status} from the Hub ({reason}), expected the request to be taken"
    return HubError(f"{hub.name}: got {said}")
