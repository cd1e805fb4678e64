"""A method, and the methods that there are: ours, and those that other packages bring."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal

from playslot_rl.config import plugins
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.errors import ConfigError

if TYPE_CHECKING:
    from playslot_rl.config.experiment import ExperimentConfig

GROUP: Final = "playslot_rl.methods"
"""Entry points by which a package brings a method: its name, and a `Method`."""


@dataclass(frozen=True)
class Style:
    """How a method looks in every plot: index into a theme's series, and a matplotlib marker."""

    colour: int
    marker: str


@dataclass(frozen=True)
class Load:
    """How a finished run is loaded, `module:function` each or empty: `actor` is `(run: Run, device) -> Actor`, `video`
    is `(run: Run, device) -> VideoPredictor`.
    """

    actor: str = ""
    video: str = ""


@dataclass(frozen=True)
class Method:
    """A method that is trained and compared.

    Attributes:
        name: as it is typed and stored.
        titles: as tables and plots name it, and what people call it besides.
        style: in plots.
        config: dataclass of its group of keys, `baselines.NAME`; None if it has none.
        stages: that are trained one after the other; the last one's checkpoint is the method's.
        load: as what it is loaded.
        told: what its policy can be told: which of several `task`s an episode is of; that, or a `goal` image in place
            of it (`model.policy.goal`); or nothing.
    """

    name: str
    titles: tuple[str, ...]
    style: Style
    config: type[Any] | None
    stages: tuple[StageSpec, ...]
    load: Load
    told: Literal["", "task", "goal"] = ""

    @property
    def title(self) -> str:
        """As tables and plots name it."""
        return self.titles[0]

    @property
    def last(self) -> StageSpec:
        """The stage whose checkpoint is the method's."""
        return self.stages[-1]

    @property
    def acts(self) -> bool:
        """Whether it gives an actor; one that does not predicts frames only."""
        return bool(self.load.actor)

    @property
    def online(self) -> bool:
        """Whether it learns by acting: it needs a reward, and is compared over environment steps."""
        return not self.last.data

    @property
    def imagines(self) -> bool:
        """Whether its policy acts in a world model of its own, too."""
        return "dynamics" in self.last.parents

    @property
    def labelled_only(self) -> bool:
        """Whether it learns from labelled demonstrations alone; what they leave out, it never sees."""
        return self.last.data == "labelled"

    @property
    def some_labelled(self) -> bool:
        """Whether it learns from all demonstrations, and from the real actions of some: `labels=`."""
        return self.last.some_labelled

    @property
    def one_policy(self) -> bool:
        """Whether its policy clones latent actions and needs no label, so that one serves any number of them."""
        return bool({"behaviour", "behaviour.policy_from"} & {*self.last.reads})

    @cached_property
    def world(self) -> tuple[str, ...]:
        """Stages of a world model that it builds on: `slots`, or `dynamics` too, or none."""
        used = {name for stage in self.stages for name in (stage.name, *stage.parents)}
        return tuple(name for name in ("slots", "dynamics") if name in used)

    @property
    def slots(self) -> bool:
        """Whether it builds on a world model's slots."""
        return "slots" in self.world

    @property
    def model(self) -> StageSpec | None:
        """The model of unlabelled videos that it trains first, for itself and for any number of demonstrations."""
        shared = ("slots", "dynamics")  # of a world model
        found = [s for s in self.stages[:-1] if s.name in self.last.parents and s.name not in shared]
        return found[0] if found else None


_OURS: Final[Mapping[str, str]] = {
    "playslot": "playslot.method:PLAYSLOT",
    "slot_oracle": "slot_oracle.method:SLOT_ORACLE",
    "resnet_oracle": "resnet_oracle.method:RESNET_ORACLE",
    "slot_bc": "slot_oracle.method:SLOT_BC",
    "resnet_bc": "resnet_oracle.method:RESNET_BC",
    "history_bc": "resnet_oracle.method:HISTORY_BC",
    "act": "lerobot_policy.method:ACT",
    "act_state": "lerobot_policy.method:ACT_STATE",
    "diffusion": "lerobot_policy.method:DIFFUSION",
    "diffusion_state": "lerobot_policy.method:DIFFUSION_STATE",
    "autoencoder_bc": "frozen_encoder.method:AUTOENCODER_BC",
    "inverse_bc": "frozen_encoder.method:INVERSE_BC",
    "slot_vpt": "slot_vpt.method:SLOT_VPT",
    "lapo": "lapo.method:LAPO",
    "lapo_slots": "lapo.slots_method:LAPO_SLOTS",
    "laom": "laom.method:LAOM",
    "clam": "clam.method:CLAM",
    "dreamer": "dreamer.method:DREAMER",
    "sold": "sold.method:SOLD",
    "caddy_policy": "caddy.method:CADDY_POLICY",
    "caddy_oracle": "caddy.method:CADDY_ORACLE",
    "svg": "svg.method:SVG",
    "caddy": "caddy.method:CADDY",
    "slotformer": "video.method:SLOTFORMER",
    "ocvp_seq": "video.method:OCVP_SEQ",
}
"""Below `playslot_rl.methods`."""


METHODS: Final = plugins.Registry(GROUP, Method, {name: f"playslot_rl.methods.{at}" for name, at in _OURS.items()})


def cloning_methods() -> list[str]:
    """Names of the methods whose policies learn from demonstrations, without acting."""
    return [name for name, method in METHODS.items() if method.acts and not method.online]


def method_stage(method: str) -> str:
    return METHODS[method].last.name


def stage_named(name: str) -> StageSpec:
    """A stage of whatever method has it."""
    return next(stage for method in METHODS.values() for stage in method.stages if stage.name == name)


def require_method(key: str, name: str) -> None:
    """Refuse a name of no method by a ValueError; a ConfigError where the package that brings it fails."""
    if name not in METHODS:
        raise ValueError(f"{key}: got {name!r}, expected one of {', '.join(METHODS)}")


def require_told(config: ExperimentConfig, name: str) -> None:
    """Refuse a method that acts and cannot be told what to do, where there are several tasks, or by goal images, where
    these are asked for, by a ConfigError.
    """
    kind = METHODS[name]
    if kind.acts and config.model.policy.goal and kind.told != "goal":
        able = ", ".join(method.name for method in METHODS.values() if method.told == "goal")
        raise ConfigError(
            f"model.policy.goal: got true with method={name}, expected one that can be shown goal images: {able}"
        )
    if config.env.tasks and kind.acts and not kind.told:
        able = ", ".join(method.name for method in METHODS.values() if method.told)
        raise ConfigError(
            f"env.task={config.env.task}: got method={name}, expected one that is told which of its tasks to do: {able}"
        )


def canonical_method(text: str, acting: bool = False) -> str:
    """The method that somebody names, by its name, title or alias; case, spaces, `-` and `_` do not matter.

    CADDY is two methods: `caddy` predicts videos, and `caddy_policy`, of the title CADDY, acts. With `acting` a word
    that names two means the one that acts; else a name comes before a title. A ConfigError where there is none, or the
    package that brings it fails.

    Examples:
        >>> canonical_method("DreamerV3"), canonical_method("slot-oracle")
        ('dreamer', 'slot_oracle')
        >>> canonical_method("CADDY"), canonical_method("CADDY", acting=True)
        ('caddy', 'caddy_policy')
    """
    if text in plugins.brought(GROUP):
        return METHODS[text].name
    words = [(word, method) for method in METHODS.values() for word in method.titles]
    words += [(method.name, method) for method in METHODS.values()]  # of equal words the last one counts
    if acting:
        words.sort(key=lambda pair: pair[1].acts)
    known = {_plain(word): method.name for word, method in words}
    if _plain(text) in known:
        return known[_plain(text)]
    near = difflib.get_close_matches(_plain(text), known, n=1)
    hint = f"; did you mean {known[near[0]]}?" if near else ""
    raise ConfigError(f"got {text!r}, expected one of {', '.join(METHODS)}{hint}")


def _plain(word: str) -> str:
    return re.sub(r"[\s_-]", "", word.lower())
