"""`playslot dataset ACTION ...`: the arguments, and what each action prints."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final


@dataclass(frozen=True)
class Action:
    """One action: what `--help` says about it, its arguments, and what it does.

    Attributes:
        summary: one line.
        details: a paragraph.
        examples: command lines.
        arguments: adds its arguments to a parser.
        run: does it and returns the exit code.
    """

    summary: str
    details: str
    examples: tuple[str, ...]
    arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def parser(kind: type[argparse.ArgumentParser] = argparse.ArgumentParser) -> argparse.ArgumentParser:
    """The parser of `playslot dataset`; `kind` says how bad arguments end."""
    width = max(map(len, ACTIONS))
    lines = "\n".join(f"  {name:<{width}}  {action.summary}" for name, action in ACTIONS.items())
    top = kind(
        prog="playslot dataset",
        usage="playslot dataset ACTION PATH [options]",
        description="Look after LeRobot v3.0 data sets, ours or others', image or video.",
        epilog=f"actions:\n{lines}\n\n`playslot dataset ACTION --help` explains one of them.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = top.add_subparsers(
        prog="playslot dataset", dest="action", metavar="ACTION", required=True, parser_class=kind
    )
    for name, action in ACTIONS.items():
        examples = "\n".join(f"  {example}" for example in action.examples)
        sub = actions.add_parser(
            name,
            description=f"{action.summary}\n\n{textwrap.fill(action.details, 100)}",
            epilog=f"examples:\n{examples}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        action.arguments(sub)
    return top


def run(options: argparse.Namespace) -> int:
    """Do what the parsed arguments ask for.

    Returns:
        The exit code: 0 done, 1 a data set that is not sound.

    Raises:
        PlaySlotError: whatever the action raises.
        KeyboardInterrupt: with a line about what that leaves.
    """
    try:
        return ACTIONS[options.action].run(options)
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(
            str(error) or "interrupted; no data set was changed, run the same command again"
        ) from error


def _print(lines: Sequence[str]) -> int:
    for line in lines:
        print(line)
    return 0


def _root(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("root", type=Path, metavar="DIR", help="folder of the data set")


def _json(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def _out(sub: argparse.ArgumentParser, what: str, required: bool = True) -> None:
    sub.add_argument("--out", type=Path, required=required, metavar="DIR", help=f"{what}; must not exist")


def _info_arguments(sub: argparse.ArgumentParser) -> None:
    _root(sub)
    _json(sub)


def _info(options: argparse.Namespace) -> int:
    from playslot_rl.datasets.info import info

    summary = info(options.root)
    return _print([summary.to_json()] if options.json else summary.lines())


def _verify(options: argparse.Namespace) -> int:
    from playslot_rl.datasets.verify import verify

    result = verify(options.root)
    _print([result.to_json()] if options.json else result.lines())
    return 0 if result.ok else 1


def _repair_arguments(sub: argparse.ArgumentParser) -> None:
    _root(sub)
    _out(sub, "write the repaired data set here and leave the damaged one in its place", required=False)


def _repair(options: argparse.Namespace) -> int:
    from playslot_rl.datasets.repair import repair

    return _print(repair(options.root, options.out).lines())


def _merge_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("roots", type=Path, nargs="+", metavar="DIR", help="folders of the data sets, two or more")
    _out(sub, "folder of the merged data set")


def _merge(options: argparse.Namespace) -> int:
    from playslot_rl.datasets.merge import merge

    return _print(merge(options.roots, options.out).lines())


def fractions(text: str) -> dict[str, float]:
    """`train=0.9,val=0.1` as a dict.

    Raises:
        argparse.ArgumentTypeError: it is not of that form, or a name comes twice.
    """
    shares: dict[str, float] = {}
    for part in text.split(","):
        name, _, share = part.partition("=")
        try:
            value = float(share)
        except ValueError:
            raise argparse.ArgumentTypeError(f"got {part!r}, expected NAME=SHARE as in train=0.9,val=0.1") from None
        if not name or name in shares:
            raise argparse.ArgumentTypeError(f"got {text!r}, expected different names as in train=0.9,val=0.1")
        shares[name] = value
    return shares


def _split_arguments(sub: argparse.ArgumentParser) -> None:
    _root(sub)
    _out(sub, "folder of the parts, one data set OUT/NAME each")
    sub.add_argument(
        "--fractions",
        type=fractions,
        required=True,
        metavar="NAME=SHARE,...",
        help="shares of the episodes, together 1",
    )
    sub.add_argument("--seed", type=int, default=0, metavar="N", help="which episodes go where (default 0)")


def _split(options: argparse.Namespace) -> int:
    from playslot_rl.datasets.split import split

    return _print(split(options.root, options.out, options.fractions, seed=options.seed).lines())


def _viz_arguments(sub: argparse.ArgumentParser) -> None:
    _root(sub)
    sub.add_argument("--episodes", type=int, default=6, metavar="N", help="episodes to show, evenly spread (default 6)")
    where = sub.add_mutually_exclusive_group()
    where.add_argument("--out", type=Path, metavar="FILE.html", help="page to write (default DIR.html beside DIR)")
    where.add_argument("--rerun", action="store_true", help="open the rerun viewer instead of writing a page")


def _viz(options: argparse.Namespace) -> int:
    from playslot_rl.datasets.viz import show_in_rerun, write_page

    if options.rerun:
        return _print([f"rerun shows episodes {show_in_rerun(options.root, options.episodes)} of {options.root}"])
    return _print([f"page: {write_page(options.root, options.out, options.episodes)}"])


def _push_arguments(sub: argparse.ArgumentParser) -> None:
    _root(sub)
    sub.add_argument("repo_id", metavar="REPO_ID", help="repository on the Hub, as in user/name")
    sub.add_argument("--private", action="store_true", help="make the repository private if it is made now")
    sub.add_argument("--branch", metavar="B", help="push to this branch; the version tag stays where it is")
    sub.add_argument("--tag", metavar="T", help="also tag the pushed commit")


def _push(options: argparse.Namespace) -> int:
    from playslot_rl.hub.push import push

    result = push(options.root, options.repo_id, private=options.private, branch=options.branch, tag=options.tag)
    return _print(result.lines())


def _pull_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("repo_id", metavar="REPO_ID", help="repository on the Hub, as in user/name")
    sub.add_argument(
        "root", type=Path, metavar="DIR", help="folder to write; must not exist, or be an interrupted pull"
    )
    sub.add_argument("--revision", metavar="R", help="branch, tag or commit (default the format's version tag)")


def _pull(options: argparse.Namespace) -> int:
    from playslot_rl.hub.pull import pull

    return _print(pull(options.repo_id, options.root, revision=options.revision).lines())


ACTIONS: Final[dict[str, Action]] = {
    "info": Action(
        "what a data set holds: episodes, tasks, features, sizes, success",
        "Reads rows and metadata, no frames.",
        ("playslot dataset info data/expert", "playslot dataset info data/expert --json"),
        _info_arguments,
        _info,
    ),
    "verify": Action(
        "check counts, indices, timestamps, every frame and the statistics",
        "Exits with 0 for a sound data set and with 1 otherwise, with a line for each fault. Also prints a fingerprint "
        "of the content, which stays the same when shards are merged anew or metadata are rewritten.",
        ("playslot dataset verify data/expert", "playslot dataset verify data/expert --json"),
        _info_arguments,
        _verify,
    ),
    "repair": Action(
        "restore an unfinalised, interrupted or damaged data set",
        "Keeps every episode whose rows are complete and whose frames can be decoded, makes counts, indices, "
        "statistics and lost metadata anew, verifies the result and says what was lost. The damaged data set is kept "
        "as DIR.damaged, or stays in its place with --out.",
        ("playslot dataset repair data/broken", "playslot dataset repair data/broken --out data/repaired"),
        _repair_arguments,
        _repair,
    ),
    "merge": Action(
        "several data sets as one",
        "They need the same features, rate and robot. Frames are copied, not encoded again; the result is verified "
        "before it gets its name.",
        ("playslot dataset merge data/part-1 data/part-2 --out data/all",),
        _merge_arguments,
        _merge,
    ),
    "split": Action(
        "one data set as several, by episodes",
        "Deals the episodes out at random, each to exactly one part; frames are copied, not encoded again.",
        ("playslot dataset split data/all --out data/parts --fractions train=0.9,val=0.1 --seed 1",),
        _split_arguments,
        _split,
    ),
    "viz": Action(
        "look at episodes: one HTML page, or rerun",
        "The page holds, for each episode shown, its frames as a small animation and as a strip, its actions and "
        "rewards, its seed and whether it succeeded. It is one file and asks the network for nothing.",
        (
            "playslot dataset viz data/expert --episodes 4 --out expert.html",
            "playslot dataset viz data/expert --rerun",
        ),
        _viz_arguments,
        _viz,
    ),
    "push": Action(
        "upload a data set to the Hugging Face Hub",
        "Verifies it first, deletes files of earlier versions there, and writes a data set card. The token is read "
        "where huggingface_hub reads it: HF_TOKEN or `hf auth login`.",
        ("playslot dataset push data/expert me/button-press --private",),
        _push_arguments,
        _push,
    ),
    "pull": Action(
        "download a data set from the Hugging Face Hub, and check it",
        "Counts and fingerprint are checked before the folder gets its name.",
        ("playslot dataset pull me/button-press data/expert --revision main",),
        _pull_arguments,
        _pull,
    ),
}
