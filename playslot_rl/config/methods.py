"""The methods that can be trained and compared, by name."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from typing import Final, Literal, get_args

from playslot_rl.errors import ConfigError

MethodName = Literal[
    "playslot", "slot_oracle", "resnet_oracle", "slot_bc", "resnet_bc", "lapo", "dreamer", "sold",
    "svg", "caddy", "slotformer", "ocvp_seq",
]  # fmt: skip


@dataclass(frozen=True)
class Method:
    """What a comparison knows of a method before it runs.

    Attributes:
        title: as tables and plots name it.
        recipe: module of `playslot_rl.recipes` whose `main(config)` trains it.
        actor: `module:function` of `load_actor(run, device) -> Actor`; empty for one that predicts frames and does not
            act (`playslot_rl.baselines.video`).
        online: it learns by acting (environment steps on the axis, needs a reward) instead of from demonstrations.
        slots: it builds on a world model's slots.
        stage: stage of its run whose checkpoint is the method's; empty means its name.
        labelled_only: it learns from labelled demonstrations alone; what they leave out, it never sees.
        aliases: what people call it besides its name and its title.
    """

    title: str
    recipe: str
    actor: str = ""
    online: bool = False
    slots: bool = False
    stage: str = ""
    labelled_only: bool = False
    aliases: tuple[str, ...] = ()


METHODS: Final[dict[str, Method]] = {
    "playslot": Method("PlaySlot", "train_policy", "playslot_rl.acting.agent:load_actor", slots=True, stage="policy"),
    "slot_oracle": Method(
        "Slot Oracle", "baselines.slot_oracle", "playslot_rl.baselines.oracles.slot:load_actor", slots=True
    ),
    "resnet_oracle": Method(
        "ResNet Oracle",
        "baselines.resnet_oracle",
        "playslot_rl.baselines.oracles.resnet:load_actor",
        aliases=("ResNet",),
    ),
    "slot_bc": Method(
        "Slot BC",
        "baselines.slot_oracle",
        "playslot_rl.baselines.oracles.slot:load_actor",
        slots=True,
        stage="slot_oracle",
        labelled_only=True,
    ),
    "resnet_bc": Method(
        "ResNet BC",
        "baselines.resnet_oracle",
        "playslot_rl.baselines.oracles.resnet:load_actor",
        stage="resnet_oracle",
        labelled_only=True,
    ),
    "lapo": Method("LAPO", "baselines.lapo", "playslot_rl.baselines.lapo.load:load_actor"),
    "dreamer": Method("DreamerV3", "baselines.online", "playslot_rl.baselines.dreamer.actor:load_actor", online=True),
    "sold": Method("SOLD", "baselines.online", "playslot_rl.baselines.sold.actor:load_actor", online=True, slots=True),
    "svg": Method("SVG-LP", "baselines.video", aliases=("SVG",)),
    "caddy": Method("CADDY", "baselines.video"),
    "slotformer": Method("SlotFormer", "baselines.video", slots=True),
    "ocvp_seq": Method("OCVP-Seq", "baselines.video", slots=True, aliases=("OCVP",)),
}


def method_stage(method: str) -> str:
    """Stage of a method's run whose checkpoint is the method's."""
    return METHODS[method].stage or method


def canonical_method(text: str) -> MethodName:
    """The method that somebody names, by its name, title or alias; case, spaces, `-` and `_` do not matter.

    Raises:
        ConfigError: there is no such method.

    Examples:
        >>> canonical_method("DreamerV3"), canonical_method("slot-oracle")
        ('dreamer', 'slot_oracle')
    """
    names: tuple[MethodName, ...] = get_args(MethodName)
    known = {_plain(word): name for name in names for word in (name, METHODS[name].title, *METHODS[name].aliases)}
    if _plain(text) in known:
        return known[_plain(text)]
    near = difflib.get_close_matches(_plain(text), known, n=1)
    hint = f"; did you mean {known[near[0]]}?" if near else ""
    raise ConfigError(f"got {text!r}, expected one of {', '.join(names)}{hint}")


def _plain(word: str) -> str:
    return re.sub(r"[\s_-]", "", word.lower())
