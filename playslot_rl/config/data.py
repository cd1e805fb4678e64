"""Config of data: where they come from, and what the collectors record (re-exported by `playslot_rl.config`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from playslot_rl.config.roles import Checked, at_least, role, within


@dataclass(frozen=True)
class DataConfig(Checked):
    """Where data come from.

    Attributes:
        root: LeRobot v3.0 data set(s) of unlabelled videos; several are separated by commas.
        demos: data set of demonstrations; empty means `root`.
        held_out: how many of its last episodes are neither trained on nor shown to the world model: they measure.
        camera: image feature(s) to read, separated by commas; empty means the only one.
        resize: resize frames of another size than `env.image_size` (area averaging) instead of refusing them.
        cache: folder of the frame and slot caches; empty means `$PLAYSLOT_CACHE` or `~/.cache/playslot_rl`.
        validation: fraction of episodes held out from training.
    """

    group = "data."
    root: str = field(default="", metadata=role("machine", "folder"))
    demos: str = field(default="", metadata=role("machine", "folder"))
    held_out: int = field(default=0, metadata=role("machine") | at_least(0, "0 or more"))
    camera: str = ""
    resize: bool = False
    cache: str = field(default="", metadata=role("machine", "folder"))
    validation: float = field(default=0.05, metadata=within(lambda value: 0 <= value < 1, "a fraction in [0, 1)"))


@dataclass(frozen=True)
class CollectConfig(Checked):
    """What the collectors record (agent steps; an episode has one more frame than actions).

    Attributes:
        random_episodes: episodes of the random policy that `pipeline` collects.
        random_steps: agent steps of each.
        expert_episodes: demonstrations that `pipeline` collects for the policy.
        validation_episodes: further ones that only measure: `demo`, `pipeline` and `compare` record so many more. Of
            any data set, at most so many of its last episodes, beyond those trained on, are looked at in validation.
        expert_steps: agent steps of each; clips go on past success.
        noise: standard deviation of Gaussian noise added to the expert's actions.
        noisy_episodes: episodes of the noisy expert that `pipeline` adds to the world model's videos.
        exploration_noise: standard deviation of its noise.
        learn_from_demos: whether the world model learns from the demonstrations' videos too (never their actions).
        storage: `image` (PNG in parquet, lossless) or `video` (h264 yuv444p, crf 0).
    """

    group = "collect."
    random_episodes: int = 400
    random_steps: int = 20
    expert_episodes: int = 150
    validation_episodes: int = field(default=10, metadata=role("machine") | at_least(0, "0 or more"))
    expert_steps: int = 20
    noise: float = 0.0
    noisy_episodes: int = 0
    exploration_noise: float = 0.5
    learn_from_demos: bool = False
    storage: Literal["image", "video"] = "image"


@dataclass(frozen=True)
class CollectorConfig(Checked):
    """How episodes are recorded, never what: the data do not depend on it.

    Attributes:
        backend: `local` processes of this machine, or actors of a `ray` cluster.
        timeout_s: seconds without an episode after which a worker counts as hanging and is started again.
        restarts: how many dead or hanging workers are replaced before the collection gives up.
        ray_address: address of the Ray cluster; empty means `$RAY_ADDRESS`, or a cluster of this machine alone.
    """

    group = "collector."
    backend: Literal["local", "ray"] = "local"
    timeout_s: float = field(default=120.0, metadata=within(lambda value: value > 0, "a number of seconds above 0"))
    restarts: int = field(default=5, metadata=at_least(0, "0 or more"))
    ray_address: str = ""
