"""Several data sets as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from playslot_rl.data.cache import cache_folder
from playslot_rl.data.contents import Contents
from playslot_rl.data.metadata import robot_of
from playslot_rl.data.prints import episode_origins
from playslot_rl.data.source import labels_of
from playslot_rl.data.views import say_shared
from playslot_rl.datasets.assemble import assemble, choose
from playslot_rl.datasets.verify import Verification, require_sound, require_verified
from playslot_rl.errors import DataError
from playslot_rl.storage.folders import new_folder, require_free


@dataclass(frozen=True)
class MergeResult:
    """What `merge` made, and of which data sets with how many episodes each."""

    out: Path
    sources: tuple[tuple[Path, int], ...]
    verification: Verification

    def lines(self) -> list[str]:
        made = self.verification
        named = ", ".join(f"{root} ({episodes})" for root, episodes in self.sources)
        counts = f"{made.episodes} episodes, {made.frames} frames"
        return [f"merged {named}", f"{self.out}: {counts}, fingerprint {made.fingerprint}"]


def merge(roots: Sequence[str | Path], out: str | Path) -> MergeResult:
    """Write the episodes of two or more data sets of one kind, one after the other, as the new data set `out`.

    Frames and rows are unchanged; tasks with the same words become one. A kill leaves no `out`.

    Raises:
        DataError: fewer than two, a damaged one, or ones that do not fit together.
        OutputError: `out` exists, or the disk is full.
    """
    folders, target = [Path(root) for root in roots], Path(out)
    if len(folders) < 2:
        raise DataError(f"merge: got {len(folders)} data set, expected at least two")
    resolved = [folder.resolve() for folder in folders]
    if len(set(resolved)) < len(resolved):
        raise DataError("merge: got the same data set twice, expected different ones; its episodes would be double")
    require_free(target, "--out ")
    contents = [require_sound(folder) for folder in folders]
    for other in contents[1:]:
        require_same_kind(contents[0], other)
    with new_folder(target, key="--out ") as temporary:
        choices = [choose(each, [span.index for span in each.spans]) for each in contents]
        assemble(choices, temporary, "playslot dataset merge")
        result = require_verified(temporary, folders)
    say_shared([(each.name, episode_origins(each, labels_of(each)["actions"], cache_folder())) for each in contents])
    return MergeResult(target, tuple((c.root, len(c.spans)) for c in contents), result)


def require_same_kind(first: Contents, other: Contents) -> None:
    """Refuse data sets of another rate, robot, features, types or shapes by a DataError."""
    if first.fps != other.fps:
        raise DataError(f"{other.root}: got {other.fps:g} fps, expected {first.fps:g} as in {first.root}; resample one")
    robots = robot_of(first.info), robot_of(other.info)
    if robots[0] != robots[1]:
        raise DataError(
            f"{other.root}: got robot_type {robots[1] or None}, expected {robots[0] or None} as in {first.root}"
        )
    names = sorted(set(first.features) ^ set(other.features))
    if names:
        raise DataError(f"{other.root}: got feature {names[0]} in only one of it and {first.root}, expected the same")
    for name, feature in first.features.items():
        got, expected = _kind(other.features[name]), _kind(feature)
        if got != expected:
            raise DataError(f"{other.root}: got feature {name} as {got}, expected {expected} as in {first.root}")


def _kind(feature: dict[str, Any]) -> str:
    names = f" named {feature['names']}" if feature.get("names") else ""
    return f"{feature['dtype']} {list(feature['shape'])}{names}"
