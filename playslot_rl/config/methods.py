"""The methods that can be trained and compared, by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

MethodName = Literal["playslot", "slot_oracle", "resnet_oracle", "lapo", "dreamer", "sold"]


@dataclass(frozen=True)
class Method:
    """What a comparison knows of a method before it runs.

    Attributes:
        title: as tables and plots name it.
        recipe: module of `playslot_rl.recipes` whose `main(config)` trains it.
        actor: `module:function` of `load_actor(run, device) -> Actor`.
        online: it learns by acting (environment steps on the axis, needs a reward) instead of from demonstrations.
        slots: it builds on a world model's slots.
    """

    title: str
    recipe: str
    actor: str
    online: bool = False
    slots: bool = False


METHODS: Final[dict[str, Method]] = {
    "playslot": Method("PlaySlot", "train_policy", "playslot_rl.acting.agent:load_actor", slots=True),
    "slot_oracle": Method(
        "Slot Oracle", "baselines.slot_oracle", "playslot_rl.baselines.oracles.slot:load_actor", slots=True
    ),
    "resnet_oracle": Method(
        "ResNet Oracle", "baselines.resnet_oracle", "playslot_rl.baselines.oracles.resnet:load_actor"
    ),
    "lapo": Method("LAPO", "baselines.lapo", "playslot_rl.baselines.lapo.load:load_actor"),
    "dreamer": Method("DreamerV3", "baselines.dreamer", "playslot_rl.baselines.dreamer.load:load_actor", online=True),
    "sold": Method("SOLD", "baselines.sold", "playslot_rl.baselines.sold.load:load_actor", online=True, slots=True),
}
