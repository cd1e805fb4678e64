"""The methods that can be trained and compared, by name."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from typing import Final, Literal, get_args

from playslot_rl.errors import ConfigError

MethodName = Literal[
    "playslot", "slot_oracle", "resnet_oracle", "slot_bc", "resnet_bc", "lapo", "dreamer", "sold",
    "caddy_policy", "caddy_oracle", "svg", "caddy", "slotformer", "ocvp_seq",
]  # fmt: skip


@dataclass(frozen=True)
class Method:
    """What a comparison knows of a method before it runs.

    Attributes:
        title: as tables and plots name it.
        recipe: module of `playslot_rl.recipes` whose `main(config)` trains it.
        actor: `module:function` of `load_actor(run, device) -> Actor`; empty for one that predicts frames and does not
            act (`playslot_rl.methods.video`).
        online: it learns by acting (environment steps on the axis, needs a reward) instead of from demonstrations.
        slots: it builds on a world model's slots.
        stage: stage of its run whose checkpoint is the method's; empty means its name.
        labelled_only: it learns from labelled demonstrations alone; what they leave out, it never sees.
        decodes: its policy clones latent actions and needs no label; a decoder reads those of the labelled
            demonstrations.
        model: stage of the model of unlabelled videos that it builds on, see `LATENT_MODELS`; its recipe has a
            `train_model(config, run)`, and its group of `baselines` a key `world` that takes it from another run.
        aliases: what people call it besides its name and its title.
    """

    title: str
    recipe: str
    actor: str = ""
    online: bool = False
    slots: bool = False
    stage: str = ""
    labelled_only: bool = False
    decodes: bool = False
    model: str = ""
    aliases: tuple[str, ...] = ()


METHODS: Final[dict[str, Method]] = {
    "playslot": Method(
        "PlaySlot", "train_policy", "playslot_rl.acting.agent:load_actor", slots=True, stage="policy", decodes=True
    ),
    "slot_oracle": Method(
        "Slot Oracle", "baselines.slot_oracle", "playslot_rl.methods.oracles.slot:load_actor", slots=True
    ),
    "resnet_oracle": Method(
        "ResNet Oracle",
        "baselines.resnet_oracle",
        "playslot_rl.methods.oracles.resnet:load_actor",
        aliases=("ResNet",),
    ),
    "slot_bc": Method(
        "Slot BC",
        "baselines.slot_oracle",
        "playslot_rl.methods.oracles.slot:load_actor",
        slots=True,
        stage="slot_oracle",
        labelled_only=True,
    ),
    "resnet_bc": Method(
        "ResNet BC",
        "baselines.resnet_oracle",
        "playslot_rl.methods.oracles.resnet:load_actor",
        stage="resnet_oracle",
        labelled_only=True,
    ),
    "lapo": Method(
        "LAPO", "baselines.lapo", "playslot_rl.methods.lapo.load:load_actor", decodes=True, model="lapo_model"
    ),
    "dreamer": Method("DreamerV3", "baselines.online", "playslot_rl.methods.dreamer.actor:load_actor", online=True),
    "sold": Method("SOLD", "baselines.online", "playslot_rl.methods.sold.actor:load_actor", online=True, slots=True),
    "caddy_policy": Method(
        "CADDY", "baselines.caddy", "playslot_rl.methods.caddy.load:load_policy", decodes=True, model="caddy"
    ),
    "caddy_oracle": Method(
        "CADDY Oracle", "baselines.caddy", "playslot_rl.methods.caddy.load:load_oracle", model="caddy"
    ),
    "svg": Method("SVG-LP", "baselines.video", aliases=("SVG",)),
    "caddy": Method("CADDY", "baselines.video"),
    "slotformer": Method("SlotFormer", "baselines.video", slots=True),
    "ocvp_seq": Method("OCVP-Seq", "baselines.video", slots=True, aliases=("OCVP",)),
}

LATENT_MODELS: Final = {"lapo_model": "LAPO's inverse and forward model", "caddy": "CADDY's video model"}
"""Models of unlabelled videos that methods build on, by stage: as pages name them. A comparison trains each once."""


def method_stage(method: str) -> str:
    """Stage of a method's run whose checkpoint is the method's."""
    return METHODS[method].stage or method


def canonical_method(text: str, acting: bool = False) -> MethodName:
    """The method that somebody names, by its name, title or alias; case, spaces, `-` and `_` do not matter.

    CADDY is two methods: `caddy` predicts videos, and `caddy_policy`, of the title CADDY, acts.

    Args:
        text: what was typed.
        acting: a word that names two methods means the one that acts; else a name comes before a title.

    Raises:
        ConfigError: there is no such method.

    Examples:
        >>> canonical_method("DreamerV3"), canonical_method("slot-oracle")
        ('dreamer', 'slot_oracle')
        >>> canonical_method("CADDY"), canonical_method("CADDY", acting=True)
        ('caddy', 'caddy_policy')
    """
    names: tuple[MethodName, ...] = get_args(MethodName)
    words = [(word, name) for name in names for word in (METHODS[name].title, *METHODS[name].aliases)]
    words += [(name, name) for name in names]  # of equal words the last one counts
    if acting:
        words.sort(key=lambda pair: bool(METHODS[pair[1]].actor))
    known = {_plain(word): name for word, name in words}
    if _plain(text) in known:
        return known[_plain(text)]
    near = difflib.get_close_matches(_plain(text), known, n=1)
    hint = f"; did you mean {known[near[0]]}?" if near else ""
    raise ConfigError(f"got {text!r}, expected one of {', '.join(names)}{hint}")


def _plain(word: str) -> str:
    return re.sub(r"[\s_-]", "", word.lower())
