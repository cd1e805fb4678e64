"""The policy's config as LeRobot reads and writes it. What the values mean: `playslot_rl.sharing.folder`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NoReturn

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig

from playslot_rl.config import EnvConfig, ModelConfig, to_dict
from playslot_rl.sharing.folder import LICENCE, OURS, TYPE, SharedPolicyConfig, camera_of

NOT_TRAINED_HERE = (
    "playslot: got a call to train, expected one to act: its three stages are trained from videos by `playslot "
    "pipeline` or `playslot train-policy`, then shared by `playslot export`"
)


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class PlaySlotConfig(PreTrainedConfig):
    """A PlaySlot policy, with the fields of `SharedPolicyConfig`, `env` and `model` as plain values. A ValueError for
    unknown keys or values outside their range in these two, and for features that do not fit them.
    """

    env: dict[str, Any] = field(default_factory=lambda: to_dict(EnvConfig()))
    model: dict[str, Any] = field(default_factory=lambda: to_dict(ModelConfig()))
    resize: bool = False
    stride: int = 1
    fps: float = 0.0
    fingerprint: str = ""
    source: dict[str, Any] = field(default_factory=dict)
    actions: dict[str, Any] | None = None
    license: str | None = LICENCE

    # LeRobot's own fields, declared again with their types, which mypy cannot read there.
    input_features: dict[str, PolicyFeature] | None = field(default_factory=dict)
    output_features: dict[str, PolicyFeature] | None = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        inputs, outputs = self.policy_config().features()
        self.input_features = self.input_features or _features(inputs)
        self.output_features = self.output_features or _features(outputs)
        self.validate_features()

    def policy_config(self) -> SharedPolicyConfig:
        """The same values as playslot_rl's own dataclass."""
        inputs = {name: {"type": feature.type.value} for name, feature in (self.input_features or {}).items()}
        camera = camera_of(inputs) if inputs else SharedPolicyConfig().camera
        return SharedPolicyConfig.of(camera, {name: getattr(self, name) for name in OURS})

    def validate_features(self) -> None:
        """Check that frames and actions have the sizes of `env`, else a ValueError."""
        inputs, outputs = self.policy_config().features()
        for got, expected in ((self.input_features, inputs), (self.output_features, outputs)):
            for name, feature in expected.items():
                found = (got or {}).get(name)
                shape = None if found is None else list(found.shape)
                if shape != feature["shape"] and not (self.resize and feature["type"] == FeatureType.VISUAL.value):
                    raise ValueError(f"{name}: got shape {shape}, expected {feature['shape']}, as in its env")

    @property
    def observation_delta_indices(self) -> None:
        """The present frame and one action a step: the past is in SAVi's state. Rewards are not used."""
        return

    action_delta_indices = reward_delta_indices = observation_delta_indices

    def get_optimizer_preset(self) -> NoReturn:
        """Refuse `lerobot-train` before it reads any data."""
        raise NotImplementedError(NOT_TRAINED_HERE)

    get_scheduler_preset = get_optimizer_preset


def _features(plain: dict[str, dict[str, Any]]) -> dict[str, PolicyFeature]:
    return {name: PolicyFeature(FeatureType(value["type"]), tuple(value["shape"])) for name, value in plain.items()}
