"""What one training of a method is, said once, by the full dotted names under which its keys are typed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from typing import Any, Literal

BASELINES = "baselines."


def renamed(key: str, names: Mapping[str, str]) -> str:
    """A dotted key with the longest of its beginnings that has another name replaced by that.

    Examples:
        >>> renamed("policy.optim.lr", {"policy": "behaviour", "policy.optim.lr": "behaviour.decoder_lr"})
        'behaviour.decoder_lr'
        >>> renamed("policy_from", {"policy": "behaviour"})
        'policy_from'
    """
    begins = [name for name in names if f"{key}.".startswith(f"{name}.")]
    longest = max(begins, key=len, default="")
    return names[longest] + key[len(longest) :] if begins else key


@dataclass(frozen=True)
class StageSpec:
    """A stage of a method.

    Attributes:
        name: of its folder in a run.
        keys: keys and groups that a finished and a half-finished one must share.
        settings: further ones that a finished one must share: those of its trainings, each of which compares its own
            when it is carried on.
        begun: further ones that only a half-finished one must share.
        also: further ones that it reads, and that make no other training.
        parents: stages it is trained on.
        copies: its run has copies of them and is whole, instead of naming the run that they lie in.
        data: what it learns from: `videos`, `demos`, the `labelled` ones of these alone; empty learns by acting.
        labels: key of the weight with which the real actions of the labelled demonstrations count in it beside the
            videos; empty sees none.
        parts: `module:function` that makes what is trained from a `StageRecord`: a `Training`.
        sizes: `module:function` that makes the group `model` from the command's config and that of its parents; empty
            takes the latter.
        title: in words, where others build on it.
        stores: groups that its checkpoint keeps beside `env` and those of `keys` and `settings`.
        names: what checkpoints call a key or group that has another name there.
        begun_names: what half-finished trainings call it.
    """

    name: str
    keys: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    begun: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    parents: tuple[str, ...] = ()
    copies: bool = False
    data: Literal["videos", "demos", "labelled", ""] = "videos"
    labels: str = ""
    parts: str = ""
    sizes: str = ""
    title: str = ""
    stores: tuple[str, ...] = ()
    names: Mapping[str, str] = field(default_factory=dict)
    begun_names: Mapping[str, str] = field(default_factory=dict)

    @property
    def some_labelled(self) -> bool:
        """Whether it learns from all demonstrations, and from the real actions of some (`behaviour.labelled_demos`)."""
        return bool({"behaviour", "behaviour.labelled_demos"} & {*self.settings})

    @property
    def reads(self) -> tuple[str, ...]:
        """Keys and groups that it reads; where it reads a group's `steps`, also how often to look, said beside it. What
        is typed for no stage that reads it is refused (`playslot_rl.config.method_keys`)."""
        return (*self.keys, *self.settings, *self.begun, *self.also)

    @cached_property
    def groups(self) -> tuple[str, ...]:
        """Groups that its checkpoint keeps, `env` first."""
        return tuple(dict.fromkeys(["env", *map(group_of, (*self.stores, *self.keys, *self.settings))]))

    @cached_property
    def own(self) -> str:
        """The group of `baselines` that is kept by its name, its settings; empty where there is none."""
        named = (g for g in self.groups if g.startswith(BASELINES) and self.stored_name(g) == self.name)
        return next(named, "").removeprefix(BASELINES)

    def sees_labels(self, config: Any) -> bool:
        """Whether real actions count in it beside the videos, so that it is another one for each draw of labels."""
        return bool(self.labels) and bool(attrgetter(self.labels)(config) > 0)

    def stored_name(self, key: str, begun: bool = False) -> str:
        """What a checkpoint, or a half-finished training, calls a key."""
        return renamed(key, {**self.names, **(self.begun_names if begun else {})}).removeprefix(BASELINES)

    def typed(self, stored: str) -> str:
        """The key that a checkpoint or a half-finished training calls so."""
        groups = {group.removeprefix(BASELINES): group for group in self.groups}
        return renamed(stored, groups | {name: key for key, name in {**self.names, **self.begun_names}.items()})


def group_of(key: str) -> str:
    """The group of the config that a key is in, as checkpoints keep them: of a method its own.

    Examples:
        >>> group_of("model.savi.dim"), group_of("baselines.lapo.code_dim")
        ('model', 'baselines.lapo')
    """
    first, *rest = key.split(".")
    return f"{BASELINES}{rest[0]}" if f"{first}." == BASELINES else first
