"""A configuration small enough for docstring examples and tests: every part is there, nothing takes a second."""

from __future__ import annotations

from typing import TYPE_CHECKING

from playslot_rl.config import (
    ActionDecoderConfig,
    EnvConfig,
    ExperimentConfig,
    InverseDynamicsConfig,
    LatentMode,
    ModelConfig,
    PolicyConfig,
    PredictorConfig,
    SAViConfig,
)

if TYPE_CHECKING:
    from playslot_rl.world_model import Agent


def tiny_config(
    mode: LatentMode = "hybrid", multi: bool = False, context: int = 8, max_steps: int = 6
) -> ExperimentConfig:
    """Frames of 64x64, N 4 slots of D 32, Z 8, K 5, networks of one or two layers of 32; with `multi` one latent action
    per slot (InvDyn_M), not one per step (InvDyn_S).
    """
    savi = SAViConfig(
        slot_dim=32,
        initial="learned",
        encoder="strided",
        encoder_channels=(8, 8, 8),
        encoder_strides=(2, 2, 1),
        token_dim=32,
        decoder="pixel_shuffle",
        decoder_channels=(16, 16, 16),
        corrector_mlp=64,
        transition_mlp=64,
    )
    inverse = InverseDynamicsConfig(
        variant="multi" if multi else "single",
        mode=mode,
        latent_dim=8,
        n_prototypes=5,
        dim=32,
        layers=2,
        heads=2,
        head_dim=16,
        mlp_dim=64,
    )
    return ExperimentConfig(
        preset="tiny",
        device="cpu",
        env=EnvConfig(max_steps=max_steps, warmup_steps=2),
        model=ModelConfig(
            savi=savi,
            inverse_dynamics=inverse,
            predictor=PredictorConfig(context=context, dim=32, layers=2, heads=2, head_dim=16, mlp_dim=64),
            policy=PolicyConfig(dim=32, layers=2, heads=2, head_dim=16, mlp_dim=64),
            action_decoder=ActionDecoderConfig(hidden_dim=32),
        ),
    )


def tiny_agent(config: ExperimentConfig | None = None, seed: int = 0) -> Agent:
    """Untrained networks of `tiny_config`, or of another, in evaluation mode, their codebook initialised, the same for
    the same seed; the global random state is left as it was.

    Examples:
        >>> tiny_agent().world_model.slot_shape
        (4, 32)
    """
    import torch

    from playslot_rl.world_model import Agent, WorldModel

    config = config or tiny_config()
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        model = WorldModel(config.model, config.env)
        if model.inverse_dynamics.n_prototypes:
            # The codebook is set by the first latents it sees; unset, its first use would change an idle model.
            model.inverse_dynamics.split(torch.randn(64, model.inverse_dynamics.latent_dim))
        return Agent.untrained(model).eval()
