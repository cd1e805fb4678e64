"""A policy of LeRobot's as a network: what its configuration is, its processors, its loss, and its chunks.

    L = policy.forward(pre(o, a)),    a_{t:t+H} = post(policy(pre(o)))

`pre` and `post` are LeRobot's processors: frames by ImageNet's statistics, as `lerobot-train` has it, actions by those
and, where it is seen, proprioception by those of the labelled demonstrations, stored with the weights.

Of several tasks the policy is told which, one of K numbers that is 1, as LeRobot's `observation.environment_state`.

Note: without proprioception, which LeRobot's Diffusion Policy cannot do without, it is one number that is 0. LeRobot
freezes the BatchNorm layers of ACT's ResNet-18, which without ImageNet's weights are the identity: here they then
learn.

Shapes: B batch, F frames, H actions of a chunk, E of them executed, A action dim, S proprioception, 0 without, K tasks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl import keys
from playslot_rl.config import EnvConfig
from playslot_rl.frames import IMAGENET_MEAN, IMAGENET_STD, normalise
from playslot_rl.methods.lerobot_policy.method import ACTConfig, ChunkConfig, DiffusionConfig, require_diffusers
from playslot_rl.modules.action_range import ActionRange

STATISTICS = ("mean", "std", "min", "max")
PAD = f"{keys.FEATURE_ACTION}_is_pad"
TRUNK = ("conv1", "bn1", "relu", "maxpool", "layer1", "layer2", "layer3", "layer4")
"""ResNet-18's parts in order; LeRobot's Diffusion Policy numbers them."""


class Observation(NamedTuple):
    """What a policy observes: frames (B, F, 3, W, W), uint8 or float [0, 1], proprioception (B, F, S) where it is seen,
    and the task int64 (B, 1) where it is told.
    """

    pixels: Tensor
    states: Tensor | None = None
    task: Tensor | None = None


class ChunkPolicy(nn.Module):
    """ACT or Diffusion Policy for frames of `image_size` and chunks of H; `make` and `chunks` are theirs."""

    statistics: Tensor
    state_statistics: Tensor

    def __init__(
        self, own: ChunkConfig, image_size: int, action_dim: int, chunk: int, state_dim: int = 0, tasks: int = 0
    ) -> None:
        super().__init__()
        from lerobot.configs import FeatureType, PolicyFeature
        from lerobot.utils.constants import OBS_ENV_STATE

        self.frames, self.chunk, self.executed, self.state_dim = own.frames, chunk, own.kept(chunk), state_dim
        self.tasks = tasks
        image = PolicyFeature(FeatureType.VISUAL, (3, image_size, image_size))
        state = {keys.FEATURE_STATE: PolicyFeature(FeatureType.STATE, (state_dim,))} if state_dim else {}
        task = {OBS_ENV_STATE: PolicyFeature(FeatureType.ENV, (tasks,))} if tasks else {}
        shared = {
            "input_features": {keys.FEATURE_IMAGE: image, **state, **task},
            "output_features": {keys.FEATURE_ACTION: PolicyFeature(FeatureType.ACTION, (action_dim,))},
            "n_action_steps": self.executed,
            "pretrained_backbone_weights": None,  # they are loaded by us, from where `weights` says
            "device": "cpu",
            "push_to_hub": False,
        }
        self.policy = self.make(own, chunk, shared)
        self.register_buffer("statistics", torch.zeros(len(STATISTICS), action_dim))
        if state_dim:
            self.register_buffer("state_statistics", torch.zeros(len(STATISTICS), state_dim))
        self.action_range = ActionRange(action_dim)
        self._processors: tuple[torch.device, Any, Any] | None = None

    def make(self, own: Any, chunk: int, shared: Mapping[str, Any]) -> Any:
        """LeRobot's policy."""
        raise NotImplementedError

    def processors(self) -> tuple[Any, Any]:
        """LeRobot's, before and after the policy."""
        raise NotImplementedError

    @property
    def stats(self) -> dict[str, dict[str, Tensor]]:
        """What LeRobot's processors normalise by."""
        image = {"mean": torch.tensor(IMAGENET_MEAN).view(3, 1, 1), "std": torch.tensor(IMAGENET_STD).view(3, 1, 1)}
        known = {keys.FEATURE_ACTION: self.statistics}
        if self.state_dim:
            known[keys.FEATURE_STATE] = self.state_statistics
        found = {name: zip(STATISTICS, rows.detach().cpu().unbind(), strict=True) for name, rows in known.items()}
        return {keys.FEATURE_IMAGE: image, **{name: dict(rows) for name, rows in found.items()}}

    def give(self, actions: Tensor, states: Tensor | None = None) -> None:
        """Take the statistics of actions (M, A) and proprioception (M, S), as LeRobot's data sets have them."""
        self.statistics.copy_(_statistics(actions))
        if states is not None:
            self.state_statistics.copy_(_statistics(states))

    def trunk(self) -> tuple[nn.Module, dict[str, str]]:
        """ResNet-18 in it, and torchvision's name of each of its tensors."""
        raise NotImplementedError

    def learn_norms(self) -> bool:
        """Have frozen BatchNorm layers learn, for a ResNet-18 that begins without ImageNet's statistics; whether there
        are any.
        """
        from torchvision.ops import FrozenBatchNorm2d

        frozen = [part for part in self.named_modules() if isinstance(part[1], FrozenBatchNorm2d)]
        for name, layer in frozen:
            norm = nn.BatchNorm2d(len(layer.weight), layer.eps, device=layer.weight.device)
            norm.num_batches_tracked = None  # so that they load into frozen ones, which act alike
            self.set_submodule(name, norm)
        return bool(frozen)

    def loss(self, seen: Observation, actions: Tensor, pad: Tensor) -> Tensor:
        """LeRobot's loss of chunks (B, H, A) in [-1, 1], where these are padding (B, H)."""
        batch = self._pre({**self.observed(seen), keys.FEATURE_ACTION: actions, PAD: pad})
        loss: Tensor = self.policy.forward(batch)[0]
        return loss

    @torch.no_grad()
    def plan(self, seen: Observation, seeds: Sequence[int]) -> Tensor:
        """The actions (B, E, A) to execute; what is drawn hangs on a row's seed alone."""
        actions = self.chunks(self._pre(self.observed(seen)), seeds)
        planned: Tensor = self._post(actions).to(seen.pixels.device)
        return planned

    def chunks(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> Tensor:
        """Chunks that begin with the present action, less what is not executed, normalised."""
        raise NotImplementedError

    def observed(self, seen: Observation) -> dict[str, Tensor]:
        """What LeRobot's policy sees, by the names of its data sets, (B, F, ...)."""
        from lerobot.utils.constants import OBS_ENV_STATE

        pixels, states, task = seen
        if states is None:
            states = torch.zeros(*pixels.shape[:2], 1, device=pixels.device)
        known = {keys.FEATURE_IMAGE: normalise(pixels), keys.FEATURE_STATE: states}
        if task is not None:
            known[OBS_ENV_STATE] = F.one_hot(task, self.tasks).float().expand(-1, self.frames, -1)
        return known

    def _pre(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        found: dict[str, Tensor] = self._made()[0](batch)
        return found

    def _post(self, actions: Tensor) -> Tensor:
        found: Tensor = self._made()[1](actions)
        return found

    def _made(self) -> tuple[Any, Any]:
        device = self.statistics.device
        if self._processors is None or self._processors[0] != device:
            self.policy.config.device = str(device)
            self._processors = (device, *self.processors())
        return self._processors[1:]


class ACTChunks(ChunkPolicy):
    def make(self, own: ACTConfig, chunk: int, shared: Mapping[str, Any]) -> Any:
        from lerobot.policies.act.configuration_act import ACTConfig as Theirs
        from lerobot.policies.act.modeling_act import ACTPolicy

        config = Theirs(
            chunk_size=chunk, dim_model=own.dim, n_heads=own.heads, dim_feedforward=own.mlp_dim,
            n_encoder_layers=own.layers, n_vae_encoder_layers=own.vae_layers, latent_dim=own.latent_dim,
            kl_weight=own.kl_weight, dropout=own.dropout, **shared,
        )  # fmt: skip
        return ACTPolicy(config)

    def processors(self) -> tuple[Any, Any]:
        from lerobot.policies.act.processor_act import make_act_pre_post_processors

        before, after = make_act_pre_post_processors(self.policy.config, self.stats)
        return before, after

    def trunk(self) -> tuple[nn.Module, dict[str, str]]:
        backbone: nn.Module = self.policy.model.backbone
        return backbone, {name: name for name in backbone.state_dict()}

    def observed(self, seen: Observation) -> dict[str, Tensor]:
        return {name: value[:, 0] for name, value in super().observed(seen).items()}

    def chunks(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> Tensor:  # noqa: ARG002
        actions: Tensor = self.policy.predict_action_chunk(batch)
        return actions[:, : self.executed]


class DiffusionChunks(ChunkPolicy):
    def make(self, own: DiffusionConfig, chunk: int, shared: Mapping[str, Any]) -> Any:
        require_diffusers()
        from lerobot.configs import FeatureType, PolicyFeature
        from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig as Theirs
        from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

        features = {keys.FEATURE_STATE: PolicyFeature(FeatureType.STATE, (1,)), **shared["input_features"]}
        config = Theirs(
            n_obs_steps=own.frames, horizon=chunk, down_dims=own.channels, num_train_timesteps=own.noise_steps,
            spatial_softmax_num_keypoints=own.keypoints, crop_shape=(own.crop, own.crop) if own.crop else None,
            num_inference_steps=own.denoising_steps or None, noise_scheduler_type=own.scheduler,
            **{**shared, "input_features": features},
        )  # fmt: skip
        return DiffusionPolicy(config)

    def processors(self) -> tuple[Any, Any]:
        from lerobot.policies.diffusion.processor_diffusion import make_diffusion_pre_post_processors

        before, after = make_diffusion_pre_post_processors(self.policy.config, self.stats)
        return before, after

    def trunk(self) -> tuple[nn.Module, dict[str, str]]:
        backbone: nn.Module = self.policy.diffusion.rgb_encoder[0].backbone
        parts = {name: name.partition(".") for name in backbone.state_dict()}
        return backbone, {name: f"{TRUNK[int(number)]}.{rest}" for name, (number, _, rest) in parts.items()}

    def chunks(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> Tensor:
        """As LeRobot's `generate_actions`, but every row has noise of its own."""
        from lerobot.utils.constants import OBS_IMAGES

        model, batch = self.policy.diffusion, dict(batch)
        batch[OBS_IMAGES] = batch[keys.FEATURE_IMAGE].unsqueeze(2)  # one camera
        drawn = [torch.Generator().manual_seed(seed) for seed in seeds]
        size = (self.chunk, self.statistics.shape[1])
        noise = torch.stack([torch.randn(size, generator=generator) for generator in drawn])
        seen = model._prepare_global_conditioning(batch)
        actions: Tensor = model.conditional_sample(
            len(seeds), global_cond=seen, generator=drawn, noise=noise.to(seen.device)
        )
        return actions[:, self.frames - 1 : self.frames - 1 + self.executed]


def chunk_policy(own: ChunkConfig, env: EnvConfig, chunk: int, state_dim: int = 0) -> ChunkPolicy:
    """The untrained policy that these settings are of; a ConfigError where its library is missing."""
    kind = DiffusionChunks if isinstance(own, DiffusionConfig) else ACTChunks
    return kind(own, env.image_size, env.action_dim, chunk, state_dim, len(env.tasks))


def _statistics(values: Tensor) -> Tensor:
    """STATISTICS of (M, ...), stacked."""
    found = values.double()
    return torch.stack((found.mean(0), found.std(0, correction=0), found.amin(0), found.amax(0)))
