"""`playslot dataset ACTION ...`: the arguments, and what each action prints."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from playslot_rl.recipes.actions import JSON, Action, Argument, argument, flag, whole
from playslot_rl.seeds.episodes import LARGEST_DRAW

USAGE: Final = "ACTION PATH [options]"
DESCRIPTION: Final = "Look after LeRobot v3.0 data sets, ours or others', image or video."


def fractions(text: str) -> dict[str, float]:
    """`train=0.9,val=0.1` as a dict; an ArgumentTypeError where it is not of that form."""
    shares: dict[str, float] = {}
    for part in text.split(","):
        name, _, share = part.partition("=")
        try:
            value = float(share)
        except ValueError:
            raise argparse.ArgumentTypeError(f"got {part!r}, expected NAME=SHARE as in train=0.9,val=0.1") from None
        if not 0 < value <= 1:
            raise argparse.ArgumentTypeError(f"got {part!r}, expected a share above 0, 1 at most")
        if not name or name in shares:
            raise argparse.ArgumentTypeError(f"got {text!r}, expected different names as in train=0.9,val=0.1")
        shares[name] = value
    return shares


ROOT: Final = argument("root", "DIR", "folder of the data set", type=Path)
REPO_ID: Final = argument("repo_id", "REPO_ID", "repository on the Hub, as in user/name")


def _out(what: str, *, required: bool = True) -> Argument:
    return argument("--out", "DIR", f"{what}; must not exist", type=Path, required=required)


ACTIONS: Final[dict[str, Action]] = {
    "info": Action(
        "what a data set holds: episodes, tasks, features, sizes, success",
        "Reads rows and metadata, no frames.",
        ("playslot dataset info data/expert", "playslot dataset info data/expert --json"),
        "playslot_rl.datasets.info:info",
        (ROOT, JSON),
    ),
    "verify": Action(
        "check counts, indices, timestamps, every frame and the statistics",
        "Exits with 0 for a sound data set and with 1 otherwise, with a line for each fault. Also prints a fingerprint "
        "of the content, which stays the same when shards are merged anew or metadata are rewritten.",
        ("playslot dataset verify data/expert", "playslot dataset verify data/expert --json"),
        "playslot_rl.datasets.verify:verify",
        (ROOT, JSON),
    ),
    "repair": Action(
        "restore an unfinalised, interrupted or damaged data set",
        "Keeps every episode whose rows are complete and whose frames can be decoded, makes counts, indices, "
        "statistics and lost metadata anew, verifies the result and says what was lost. The damaged data set is kept "
        "as DIR.damaged, or stays in its place with --out.",
        ("playslot dataset repair data/broken", "playslot dataset repair data/broken --out data/repaired"),
        "playslot_rl.datasets.repair:repair",
        (ROOT, _out("write the repaired data set here and leave the damaged one in its place", required=False)),
    ),
    "merge": Action(
        "several data sets as one",
        "They need the same features, rate and robot. Frames are copied, not encoded again; the result is verified "
        "before it gets its name.",
        ("playslot dataset merge data/part-1 data/part-2 --out data/all",),
        "playslot_rl.datasets.merge:merge",
        (
            argument("roots", "DIR", "folders of the data sets, two or more", type=Path, nargs="+"),
            _out("folder of the merged data set"),
        ),
    ),
    "split": Action(
        "one data set as several, by episodes",
        "Deals the episodes out at random, each to exactly one part, or without --fractions by their tasks; frames are "
        "copied, not encoded again.",
        (
            "playslot dataset split data/all --out data/parts --fractions train=0.9,val=0.1 --seed 1",
            "playslot dataset split data/all --out data/tasks",
        ),
        "playslot_rl.datasets.split:split",
        (
            ROOT,
            _out("folder of the parts, one data set OUT/NAME each"),
            argument(
                "--fractions",
                "NAME=SHARE,...",
                "shares of the episodes, together 1 (default a part for each task)",
                type=fractions,
            ),
            argument("--seed", "N", "which episodes go where (default 0)", type=whole(0, LARGEST_DRAW), default=0),
        ),
    ),
    "viz": Action(
        "look at episodes: one HTML page, or rerun",
        "The page holds, for each episode shown, its frames as a small animation and as a strip, its actions and "
        "rewards, its seed and whether it succeeded. It is one file and asks the network for nothing.",
        (
            "playslot dataset viz data/expert --episodes 4 --out expert.html",
            "playslot dataset viz data/expert --rerun",
        ),
        "playslot_rl.datasets.viz:view",
        (
            ROOT,
            argument("--episodes", "N", "episodes to show, evenly spread (default 6)", type=whole(1, 10**6), default=6),
        ),
        (
            argument("--out", "FILE.html", "page to write (default DIR.html beside DIR)", type=Path),
            flag("--rerun", "open the rerun viewer instead of writing a page"),
        ),
    ),
    "push": Action(
        "upload a data set to the Hugging Face Hub",
        "Verifies it first, deletes files of earlier versions there, and writes a data set card. The token is read "
        "where huggingface_hub reads it: HF_TOKEN or `hf auth login`.",
        ("playslot dataset push data/expert me/button-press --private",),
        "playslot_rl.hub.push:push",
        (
            ROOT,
            REPO_ID,
            flag("--private", "make the repository private if it is made now"),
            argument("--branch", "B", "push to this branch; the version tag stays where it is"),
            argument("--tag", "T", "also tag the pushed commit"),
        ),
    ),
    "pull": Action(
        "download a data set from the Hugging Face Hub, and check it",
        "Counts and fingerprint are checked before the folder gets its name.",
        ("playslot dataset pull me/button-press data/expert --revision main",),
        "playslot_rl.hub.pull:pull",
        (
            REPO_ID,
            argument("root", "DIR", "folder to write; must not exist, or be an interrupted pull", type=Path),
            argument("--revision", "R", "branch, tag or commit (default the format's version tag)"),
        ),
        writes="root",
    ),
}
