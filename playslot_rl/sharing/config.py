"""What `config.json` of a model folder says, as a dataclass and as the plain values LeRobot reads.

LeRobot 0.6.1 finds a policy's class by `type`; the shapes of what goes in and out are its `input_features` and
`output_features`. The rest, `env` to `source`, is ours: sizes of the networks and where the weights came from.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from playslot_rl import keys
from playslot_rl.config import EnvConfig, ModelConfig, from_dict, to_dict
from playslot_rl.errors import CheckpointError

TYPE: Final = "playslot"
"""Name under which the second distribution, `lerobot_policy_playslot`, registers the policy at LeRobot."""
CONFIG: Final = "config.json"
WEIGHTS: Final = "model.safetensors"
LICENCE: Final = "apache-2.0"
TAGS: Final = ("robotics", "lerobot", TYPE)

OURS: Final = ("env", "model", "resize", "fingerprint", "source")
"""Keys of `config.json` that LeRobot does not know."""


@dataclass(frozen=True)
class SharedPolicyConfig:
    """A shared policy.

    Attributes:
        env: the task it was trained on: frame size, action width, agent steps.
        model: sizes of the networks.
        camera: LeRobot feature of the frames it looks at.
        resize: frames of another size are resized by area averaging, as in training; False refuses them.
        fingerprint: first 16 hex digits of the SHA-256 of the weights file.
        source: where the weights came from (`playslot_rl.sharing.source`), plain values.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    camera: str = keys.FEATURE_IMAGE
    resize: bool = False
    fingerprint: str = ""
    source: dict[str, Any] = field(default_factory=dict)

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
            "tags": [*TAGS, self.env.name],
            "env": to_dict(self.env),
            "model": to_dict(self.model),
            "resize": self.resize,
            "fingerprint": self.fingerprint,
            "source": self.source,
        }

    @classmethod
    def of(cls, camera: str, ours: dict[str, Any]) -> SharedPolicyConfig:
        """The config of `env`, `model`, `resize`, `fingerprint` and `source` as plain values.

        Raises:
            ValueError: unknown keys, wrong types, or values outside their range.
        """
        return cls(
            env=from_dict(EnvConfig, ours["env"], "env."),
            model=from_dict(ModelConfig, ours["model"], "model."),
            camera=camera,
            resize=bool(ours.get("resize", False)),
            fingerprint=str(ours.get("fingerprint", "")),
            source=dict(ours.get("source") or {}),
        )


def camera_of(inputs: dict[str, Any]) -> str:
    """The one camera among LeRobot's input features, as plain values.

    Raises:
        ValueError: there is none, or there are several.
    """
    cameras = [name for name, feature in inputs.items() if feature["type"] == "VISUAL"]
    if len(cameras) != 1:
        raise ValueError(f"input_features: got {len(cameras)} cameras ({', '.join(cameras)}), expected one")
    return cameras[0]


def is_model_folder(folder: Path) -> bool:
    """Whether a folder says that it holds a PlaySlot policy."""
    try:
        values = json.loads((folder / CONFIG).read_text())
    except (OSError, ValueError):
        return False
    return isinstance(values, dict) and values.get("type") == TYPE


def read_config(folder: Path) -> SharedPolicyConfig:
    """Read `config.json` of a model folder.

    Raises:
        CheckpointError: it is missing, damaged, another policy's, or of another version.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise CheckpointError(f"{path} is missing, expected the folder of a policy: make one by `playslot export`")
    try:
        values = json.loads(path.read_text())
    except ValueError as error:
        raise CheckpointError(f"{path} is damaged ({error}), expected JSON: export the policy again") from error
    kind = values.get("type") if isinstance(values, dict) else None
    if kind != TYPE:
        raise CheckpointError(f"{path}: got a policy of type {kind!r}, expected {TYPE!r}: check the folder")
    try:
        return SharedPolicyConfig.of(camera_of(values["input_features"]), {key: values[key] for key in OURS})
    except (KeyError, TypeError, ValueError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise CheckpointError(
            f"{path}: {what}; expected a config of this version of playslot_rl: export the policy again"
        ) from error
