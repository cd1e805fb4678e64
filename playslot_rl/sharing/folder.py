"""A policy as a folder that LeRobot loads: config, weights, processors and card.

    FOLDER/config.json                  `SharedPolicyConfig`
    FOLDER/model.safetensors            `agent.*`: world model, latent policy, action decoder
    FOLDER/policy_preprocessor.json     LeRobot's pipeline before the policy
    FOLDER/policy_postprocessor.json    and the one after it
    FOLDER/policy_postprocessor_step_1_unnormalizer_processor.safetensors
                                        its range of the actions, where they are not in [-1, 1]
    FOLDER/README.md                    model card

LeRobot 0.6.1 finds a policy's class by `type` in `config.json`. The slot oracle of a run stays behind: it was trained
on every real action, and is no part of the policy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import torch
from torch import nn

from playslot_rl import keys
from playslot_rl.config import EnvConfig, ModelConfig, from_dict, to_dict
from playslot_rl.config.compose import EXPORTED
from playslot_rl.data.action_limits import said, scaled
from playslot_rl.data.metadata import json_content
from playslot_rl.envs import RECORDED
from playslot_rl.errors import CheckpointError
from playslot_rl.storage.atomic import write_json, write_text
from playslot_rl.storage.folders import new_folder
from playslot_rl.storage.tensors import load_modules, load_tensors, module_tensors, save_tensors, weights_fingerprint

if TYPE_CHECKING:
    from playslot_rl.modules.action_range import ActionRange
    from playslot_rl.world_model import Agent


TYPE: Final = EXPORTED
"""Name under which the second distribution, `lerobot_policy_playslot`, registers the policy at LeRobot."""
CONFIG: Final = "config.json"
WEIGHTS: Final = "model.safetensors"
LICENCE: Final = "apache-2.0"
TAGS: Final = ("robotics", "lerobot", TYPE)

_PLAIN: Final[dict[str, Callable[[Any], Any]]] = {
    "resize": bool, "stride": int, "fps": float, "fingerprint": str, "source": dict, "actions": dict,
}  # fmt: skip
OURS: Final = ("env", "model", *_PLAIN)
"""Keys of `config.json` that LeRobot does not know; `actions` only where they may have a range of their own."""


@dataclass(frozen=True)
class SharedPolicyConfig:
    """A shared policy.

    Attributes:
        env: the task it was trained on: frame size, action width, agent steps.
        camera: LeRobot feature of the frames it looks at.
        resize: frames of another size are resized by area averaging, as in training; False refuses them.
        stride: every so-many-th frame of the demonstrations' videos was trained on, and is what it has to be shown.
        fps: frames a second that it has to be shown, those of the videos over the stride; 0 where it is not known.
        fingerprint: first 16 hex digits of the SHA-256 of the weights file.
        source: where the weights came from (`playslot_rl.sharing.run`), plain values.
        actions: `names`, `low` and `high` of the actions, A each, in the units of the data set that they were learned
            from; empty for those of our simulators, which are in [-1, 1].
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    camera: str = keys.FEATURE_IMAGE
    resize: bool = False
    stride: int = 1
    fps: float = 0.0
    fingerprint: str = ""
    source: dict[str, Any] = field(default_factory=dict)
    actions: dict[str, Any] = field(default_factory=dict)

    @property
    def told(self) -> tuple[str, ...]:
        """What it can be told to do, in the words of the data sets; empty where it has one task."""
        return () if self.model.policy.goal else self.env.sentences

    def features(self) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Any]]]:
        """LeRobot's input and output features; shapes are (3, H, W) and (A,)."""
        side = self.env.image_size
        return (
            {self.camera: {"type": "VISUAL", "shape": [3, side, side]}},
            {keys.FEATURE_ACTION: {"type": "ACTION", "shape": [self.env.action_dim]}},
        )

    def to_lerobot(self) -> dict[str, Any]:
        """The plain values of `config.json`; what is left out is LeRobot's default."""
        inputs, outputs = self.features()
        return {
            "type": TYPE,
            "n_obs_steps": 1,
            "input_features": inputs,
            "output_features": outputs,
            "device": "cpu",
            "license": LICENCE,
            "tags": [*TAGS, self.env.full_name],
            "env": to_dict(self.env),
            "model": to_dict(self.model),
            "resize": self.resize,
            "stride": self.stride,
            "fps": self.fps,
            "fingerprint": self.fingerprint,
            "source": self.source,
            **({"actions": self.actions} if self.actions or self.env.name in RECORDED else {}),
        }

    @classmethod
    def of(cls, camera: str, ours: dict[str, Any]) -> SharedPolicyConfig:
        """The config of `OURS` as plain values, of which older folders may lack some; a ValueError where one is
        unknown, of another type or outside its range.
        """
        env, model = from_dict(EnvConfig, ours["env"], "env."), from_dict(ModelConfig, ours["model"], "model.")
        plain = {name: kind(ours[name]) for name, kind in _PLAIN.items() if ours.get(name) is not None}
        return cls(env=env, model=model, camera=camera, **plain)


def camera_of(inputs: dict[str, Any]) -> str:
    """The one camera among LeRobot's input features, as plain values, else a ValueError."""
    cameras = [name for name, feature in inputs.items() if feature["type"] == "VISUAL"]
    if len(cameras) != 1:
        raise ValueError(f"input_features: got {len(cameras)} cameras ({', '.join(cameras)}), expected one")
    return cameras[0]


def is_model_folder(folder: Path) -> bool:
    """Whether a folder says that it holds a PlaySlot policy."""
    try:
        values = json_content(folder / CONFIG)
    except (OSError, ValueError):
        return False
    return isinstance(values, dict) and values.get("type") == TYPE


def read_config(folder: Path) -> SharedPolicyConfig:
    """`config.json` of a model folder; a CheckpointError where it is missing, damaged, another policy's, or of another
    version.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise CheckpointError(f"{path} is missing, expected the folder of a policy: make one by `playslot export`")
    try:
        values = json_content(path)
    except ValueError as error:
        raise CheckpointError(f"{path} is damaged ({error}), expected JSON: export the policy again") from error
    kind = values.get("type") if isinstance(values, dict) else None
    if isinstance(values, dict) and "preset" in values:
        raise CheckpointError(f"{folder}: got a run, expected a policy: use playslot_rl.load, or `playslot export` it")
    if kind != TYPE:
        raise CheckpointError(f"{path}: got a policy of type {kind!r}, expected {TYPE!r}: check the folder")
    try:
        ours = {key: values[key] for key in OURS if key in values}
        config = SharedPolicyConfig.of(camera_of(values["input_features"]), ours)
        for name, stated, made in zip(("in", "out"), _shapes(values), _shapes(config.to_lerobot()), strict=True):
            if stated != made:
                raise ValueError(f"{name}put_features: got shapes {stated}, but env and model are of {made}")
        require_range(config.env, ours.get("actions"))
        return config
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise CheckpointError(
            f"{path}: {what}; expected a config of this version of playslot_rl: export the policy again"
        ) from error


def require_range(env: EnvConfig, actions: dict[str, Any] | None) -> None:
    """Refuse a policy for a robot of a version that knew no range of its actions, by a ValueError."""
    if env.name in RECORDED and actions is None:
        raise ValueError("got a policy that clips the robot's actions to [-1, 1]: train it again")


def _shapes(values: dict[str, Any]) -> list[dict[str, list[int]]]:
    """Of what goes in and of what comes out of a policy, by the values of its `config.json`."""
    sides = (values["input_features"], values["output_features"])
    return [{name: list(feature["shape"]) for name, feature in side.items()} for side in sides]


CARD: Final = "README.md"
PREPROCESSOR: Final = "policy_preprocessor"
POSTPROCESSOR: Final = "policy_postprocessor"
FILES: Final = (CONFIG, WEIGHTS, f"{PREPROCESSOR}.json", f"{POSTPROCESSOR}.json", CARD)
"""Everything a model folder holds, beside `RANGE`."""
RANGE: Final = f"{POSTPROCESSOR}_step_1_unnormalizer_processor.safetensors"
"""State of LeRobot's step that gives actions in the robot's units; not there where they are in [-1, 1]."""
ROOT: Final = "agent"
"""First part of every tensor's name, as of a LeRobot policy whose attribute `agent` is the agent."""


def build_agent(config: SharedPolicyConfig) -> Agent:
    """Networks of a config with fresh weights, without a slot oracle; the global random state stays as it was."""
    from playslot_rl.world_model import Agent, WorldModel

    with torch.random.fork_rng(devices=[]):
        return Agent.untrained(WorldModel(config.model, config.env), oracle=False)


def shared_modules(agent: nn.Module) -> dict[str, nn.Module]:
    """The modules of an agent that are stored, by the names of their tensors."""
    return {f"{ROOT}.{name}": getattr(agent, name) for name in ("world_model", "policy", "action_decoder")}


def write_weights(agent: nn.Module, path: Path) -> str:
    """Write an agent's weights, atomically, and return their fingerprint."""
    save_tensors(path, module_tensors(shared_modules(agent)))
    return weights_fingerprint(path)


def load_weights(agent: nn.Module, path: Path, config: SharedPolicyConfig) -> None:
    """Load a weights file into an agent, in place; nothing is changed unless everything fits, else a CheckpointError:
    the tensors, and the fingerprint (empty says nothing) and range of the actions that the config names.
    """
    if not path.is_file():
        raise CheckpointError(f"{path} is missing, expected a policy's weights: export or download the policy again")
    tensors = load_tensors(path)
    got = weights_fingerprint(path)
    load_modules(shared_modules(agent), tensors, str(path))
    if config.fingerprint and got != config.fingerprint:
        raise CheckpointError(
            f"{path}: got fingerprint {got}, expected {config.fingerprint} from its config.json: the file was "
            "changed or damaged; export or download the policy again"
        )
    stored = ranged(agent, config)
    if stored != config.actions:
        raise CheckpointError(
            f"{path}: got actions in the range {said(stored)}, expected {said(config.actions)} from its config.json: "
            "the file was changed; export or download the policy again"
        )


def ranged(agent: Any, config: SharedPolicyConfig) -> dict[str, Any]:
    """The `actions` of a config with the range that an agent's decoder has."""
    known: ActionRange = agent.action_decoder.action_range
    if known.unit and not scaled(config.actions):
        return config.actions
    low, high = known.low.tolist(), known.high.tolist()
    names = config.actions.get("names") or [f"action_{i}" for i in range(len(low))]
    return {**config.actions, "names": names, "low": low, "high": high}


def save_pretrained(
    agent: Agent, folder: Path, config: SharedPolicyConfig, card: Callable[[SharedPolicyConfig], str]
) -> SharedPolicyConfig:
    """Write a model folder, whole or not at all: an OutputError where it holds something or cannot be written. Returns
    the config with its fingerprint and the ends of `actions`, of which `card` makes the text of README.md.
    """
    with new_folder(folder) as temporary:
        config = replace(config, fingerprint=write_weights(agent, temporary / WEIGHTS), actions=ranged(agent, config))
        write_json(temporary / CONFIG, config.to_lerobot())
        for pipeline in make_processors("cpu", config.actions):
            pipeline.save_pretrained(temporary, config_filename=f"{pipeline.name}.json")
        write_text(temporary / CARD, card(config))
    return config


def load_pretrained(folder: Path, device: torch.device | str = "cpu") -> tuple[Agent, SharedPolicyConfig]:
    """Agent and config of a model folder; the agent in evaluation mode, without gradients for its weights. A
    CheckpointError where the folder is not whole, or its files do not belong together.
    """
    if not folder.is_dir():
        raise CheckpointError(f"{folder}: no such folder, expected a policy made by `playslot export`")
    config = read_config(folder)
    agent = build_agent(config)
    load_weights(agent, folder / WEIGHTS, config)
    agent.to(device).eval().requires_grad_(False)
    return agent, config


def files_of(config: SharedPolicyConfig) -> tuple[str, ...]:
    return (*FILES, RANGE) if scaled(config.actions) else FILES


def require_whole(folder: Path) -> SharedPolicyConfig:
    """The config of a model folder in which every file is there and the weights load, else a CheckpointError."""
    _, config = load_pretrained(folder)
    missing = [name for name in files_of(config) if not (folder / name).is_file()]
    if missing:
        raise CheckpointError(f"{folder}: {missing[0]} is missing, expected a whole policy: export it again")
    return config


def make_processors(device: str, actions: dict[str, Any] | None = None) -> tuple[Any, Any]:
    """LeRobot's pipelines before and after the policy: rename, add a batch dimension, move to the device; and back.

    Frames go in as LeRobot gives them, floats in [0, 1]. The policy gives actions in [-1, 1], as LeRobot's policies do;
    LeRobot's own normaliser turns them into those of the robot, on the CPU, where they have another range.
    """
    from lerobot import processor
    from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature

    inwards = [
        processor.RenameObservationsProcessorStep(rename_map={}),
        processor.AddBatchDimensionProcessorStep(),
        processor.DeviceProcessorStep(device=device),
    ]
    outwards: list[Any] = [processor.DeviceProcessorStep(device="cpu")]
    if actions and scaled(actions):
        outwards.append(
            processor.UnnormalizerProcessorStep(
                features={keys.FEATURE_ACTION: PolicyFeature(FeatureType.ACTION, (len(actions["low"]),))},
                norm_map={FeatureType.ACTION: NormalizationMode.MIN_MAX},
                stats={keys.FEATURE_ACTION: {"min": actions["low"], "max": actions["high"]}},
            )
        )
    after = processor.PolicyProcessorPipeline(
        steps=outwards,
        name=POSTPROCESSOR,
        to_transition=processor.policy_action_to_transition,
        to_output=processor.transition_to_policy_action,
    )
    return processor.PolicyProcessorPipeline(steps=inwards, name=PREPROCESSOR), after
