"""Config of sizes: SAVi, InvDyn, cOCVP, policy, action decoder (re-exported by `playslot_rl.config`)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, Literal

from playslot_rl.config.plain import check
from playslot_rl.config.roles import (
    COUNT,
    LAYERS,
    NOT_NEGATIVE,
    OPEN_FRACTION,
    UNSAID,
    Checked,
    at_least,
    below_one,
    between,
    set_by,
    was,
    within,
)

LatentMode = Literal["hybrid", "discrete", "continuous", "ground_truth", "none"]
CHOSEN: Final = UNSAID | at_least(1, "numbers of slots from 1 on")
"""Of a choice of slots."""


def _check_once(sizes: InverseDynamicsConfig | PolicyConfig) -> None:
    check(len(set(sizes.slots)) == len(sizes.slots), f"{sizes.group}slots", sizes.slots, "each slot once")


@dataclass(frozen=True)
class SAViConfig(Checked):
    """Sizes of SAVi (paper, appendix A.1).

    Attributes:
        n_slots: N.
        slot_dim: D.
        initial: `gaussian` (learned mean and scale shared by all slots; paper) or `learned` (one vector per slot).
        encoder: `full` (four 5x5 stride-1 convs; paper) or `strided` (5x5 convs with `encoder_strides`).
        encoder_channels: channels of each encoder conv.
        encoder_strides: strides of the encoder convs; `full` takes only 1.
        token_dim: width of the encoder tokens' MLP and of q, k, v.
        decoder: `broadcast` (full-resolution spatial broadcast; paper) or `pixel_shuffle` (from 8x8 upwards).
        decoder_channels: channels of the decoder.
        decoder_position: `linear` (a linear map of the coordinates; paper) or, for `pixel_shuffle`, `learned` (a free
            8x8 map is added, so that a still background does not have to be made out of ramps).
        decoder_start: side of the map from which `pixel_shuffle` goes upwards, 8 or 16.
        collapse: use the collapsed first layer of the broadcast decoder (exact; `false` computes it plainly).
        first_iterations: Slot Attention iterations on an episode's first frame.
        iterations: iterations on every later frame.
        corrector_mlp: hidden width of the corrector's residual MLP.
        transition_heads: heads of the transition block, of width D / heads.
        transition_mlp: hidden width of the transition block's MLP.
        transition_start: how the transition's weights start: `xavier` (as all others) or `identity` (it starts by
            handing slots on as they are, so that no two of them learn to change places at every frame).
    """

    group = "model.savi."
    n_slots: int = field(default=4, metadata=at_least(1))
    slot_dim: int = field(default=128, metadata=COUNT)
    initial: Literal["gaussian", "learned"] = "gaussian"
    encoder: Literal["full", "strided"] = "full"
    encoder_channels: tuple[int, ...] = field(default=(32, 32, 32, 32), metadata=COUNT)
    encoder_strides: tuple[int, ...] = field(default=(1, 1, 1, 1), metadata=between(1, 8, "1 to 8"))
    token_dim: int = field(default=128, metadata=COUNT)
    decoder: Literal["broadcast", "pixel_shuffle"] = "broadcast"
    decoder_channels: tuple[int, ...] = field(default=(64, 64, 64, 64), metadata=COUNT)
    decoder_position: Literal["linear", "learned"] = "linear"
    decoder_start: int = field(
        default=8, metadata=was(8) | UNSAID | within(lambda value: value in (8, 16), "8 or 16", 8, 16)
    )
    collapse: bool = True
    first_iterations: int = field(default=3, metadata=LAYERS)
    iterations: int = field(default=1, metadata=LAYERS)
    corrector_mlp: int = field(default=256, metadata=COUNT)
    transition_heads: int = field(default=4, metadata=COUNT)
    transition_mlp: int = field(default=512, metadata=COUNT)
    transition_start: Literal["xavier", "identity"] = "xavier"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("encoder_channels", "decoder_channels"):
            check(len(getattr(self, name)) > 0, self.group + name, getattr(self, name), "at least one width")
        strides, heads = self.encoder_strides, self.transition_heads
        fit = len(self.encoder_channels) == len(strides)
        each = f"one stride for each of the {len(self.encoder_channels)} encoder channels"
        check(fit, "model.savi.encoder_strides", strides, each)
        full = self.encoder == "strided" or set(strides) <= {1}
        check(full, "model.savi.encoder_strides", strides, "strides of 1 with model.savi.encoder=full")
        position = self.decoder_position == "linear" or self.decoder == "pixel_shuffle"
        linear = f"linear with model.savi.decoder={self.decoder}"
        check(position, "model.savi.decoder_position", self.decoder_position, linear)
        upwards = self.decoder_start == 8 or self.decoder == "pixel_shuffle"
        check(upwards, "model.savi.decoder_start", self.decoder_start, f"8 with model.savi.decoder={self.decoder}")
        divides = self.slot_dim % heads == 0
        check(divides, "model.savi.transition_heads", heads, f"a divisor of slot_dim {self.slot_dim}")


@dataclass(frozen=True)
class InverseDynamicsConfig(Checked):
    """Sizes of InvDyn and its quantiser (paper, appendix A.2).

    Attributes:
        variant: `single` (InvDyn_S, one z per step) or `multi` (InvDyn_M, one z per slot and step).
        mode: latent-action mode; `none` infers nothing, for predictors without control.
        latent_dim: Z.
        n_prototypes: K.
        dim, layers, heads, head_dim, mlp_dim: transformer of InvDyn_S; `dim` is the hidden width of InvDyn_M.
        decay: EMA decay of the codebook.
        dead_threshold: EMA cluster size under which a code is revived by a random latent.
        commitment: weight beta of the commitment term.
        sample: sample z at evaluation too.
        slots: those whose change z tells, from 1; none: all.
    """

    group = "model.inverse_dynamics."
    variant: Literal["single", "multi"] = "single"
    mode: LatentMode = "hybrid"
    latent_dim: int = field(default=16, metadata=COUNT)
    n_prototypes: int = field(default=8, metadata=at_least(2))
    dim: int = field(default=256, metadata=COUNT)
    layers: int = field(default=4, metadata=LAYERS)
    heads: int = field(default=4, metadata=COUNT)
    head_dim: int = field(default=64, metadata=COUNT)
    mlp_dim: int = field(default=1024, metadata=COUNT)
    decay: float = field(default=0.99, metadata=OPEN_FRACTION)
    dead_threshold: float = field(default=1.0, metadata=NOT_NEGATIVE)
    commitment: float = field(default=0.25, metadata=NOT_NEGATIVE)
    sample: bool = False
    slots: tuple[int, ...] = field(default=(), metadata=CHOSEN)

    def __post_init__(self) -> None:
        super().__post_init__()
        alone = not self.slots or self.variant == "single"
        check(
            alone, f"{self.group}slots", self.slots, "none with variant=multi, which has a latent action for each slot"
        )
        _check_once(self)

    def seen(self, n: int) -> list[int]:
        """Of n slots, counted from 0, those whose change z tells."""
        return [number - 1 for number in self.slots] or list(range(n))


@dataclass(frozen=True)
class PredictorConfig(Checked):
    """Kind and sizes of the predictor (paper, appendix A.3).

    Attributes:
        kind: `cocvp` (paper), `ocvp_seq` (OCVP-Seq, with an action token as in SOLD where there are latent actions) or
            `slotformer` (SlotFormer, which takes none).
        dim, layers, heads, head_dim, mlp_dim: the transformer.
        project_out: attention has an output projection; without one `heads * head_dim` is `dim`.
        residual: predict the change of the slots instead of the slots.
        context: frames it attends to; past them the window slides and is recomputed.
    """

    group = "model.predictor."
    kind: Literal["cocvp", "ocvp_seq", "slotformer"] = field(default="cocvp", metadata=was("cocvp"))
    dim: int = field(default=256, metadata=COUNT)
    layers: int = field(default=4, metadata=LAYERS)
    heads: int = field(default=8, metadata=COUNT)
    head_dim: int = field(default=64, metadata=COUNT)
    mlp_dim: int = field(default=1024, metadata=COUNT)
    residual: bool = False
    context: int = field(default=24, metadata=at_least(2, "at least 2 frames"))
    project_out: bool = field(default=True, metadata=was(True))

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self.dim % 2 == 0, f"{self.group}dim", self.dim, "an even number: sines and cosines of a position")
        fits = self.project_out or self.heads * self.head_dim == self.dim
        parts = f"dim / heads with project_out=false, dim {self.dim} and {self.heads} heads"
        check(fits, f"{self.group}head_dim", self.head_dim, parts)


@dataclass(frozen=True)
class PolicyConfig(Checked):
    """Sizes of the latent policy: InvDyn_S's architecture with one head (paper, appendix A.4).

    Attributes:
        dim, layers, heads, head_dim, mlp_dim: the transformer.
        whiten: it gives whitened coordinates; `behaviour.whiten` sets it.
        slots: those that it sees, from 1; none: all.
        gain: `behaviour.gain` sets it.
        goal: it is shown a goal image.
    """

    group = "model.policy."
    dim: int = field(default=256, metadata=COUNT)
    layers: int = field(default=4, metadata=LAYERS)
    heads: int = field(default=4, metadata=COUNT)
    head_dim: int = field(default=64, metadata=COUNT)
    mlp_dim: int = field(default=1024, metadata=COUNT)
    whiten: bool = field(default=False, metadata=was(False) | set_by("behaviour.whiten"))
    slots: tuple[int, ...] = field(default=(), metadata=CHOSEN)
    gain: float = field(default=1.0, metadata=UNSAID | between(0, 1, "0 to 1") | set_by("behaviour.gain"))
    goal: bool = field(default=False, metadata=UNSAID)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_once(self)

    @property
    def of_frames(self) -> PolicyConfig:
        """The same of a policy whose tokens are places in a frame, not slots."""
        return replace(self, slots=())


@dataclass(frozen=True)
class ActionDecoderConfig(Checked):
    """Sizes of the action decoder: a three-layer MLP (paper, appendix A.4).

    Attributes:
        hidden_dim: hidden width.
        state_dim, state_layers, state_heads: width, layers and heads of the slot encoder beside it, for
            `behaviour.decoder_state`.
        whiten: its inputs are whitened; `behaviour.whiten` sets it.
        reads_slots: there is a slot encoder; `behaviour.decoder_state` sets it.
        slots: `model.policy.slots` sets it.
        state_dropout: fraction of training rows in which the network that reads slots goes without.
    """

    group = "model.action_decoder."
    hidden_dim: int = field(default=128, metadata=at_least(1))
    state_dim: int = field(default=64, metadata=was(64) | at_least(1))
    state_layers: int = field(default=2, metadata=was(2) | LAYERS)
    state_heads: int = field(default=4, metadata=was(4) | at_least(1))
    state_dropout: float = field(default=0.5, metadata=was(0.5) | below_one("0 to below 1"))
    whiten: bool = field(default=False, metadata=was(False) | set_by("behaviour.whiten"))
    reads_slots: bool = field(default=False, metadata=was(False) | set_by("behaviour.decoder_state"))
    slots: tuple[int, ...] = field(default=(), metadata=CHOSEN | set_by("model.policy.slots"))

    def __post_init__(self) -> None:
        super().__post_init__()
        heads = f"a multiple of state_heads, {self.state_heads}"
        check(self.state_dim % self.state_heads == 0, "model.action_decoder.state_dim", self.state_dim, heads)


@dataclass(frozen=True)
class ModelConfig:
    """All sizes."""

    savi: SAViConfig = field(default_factory=SAViConfig)
    inverse_dynamics: InverseDynamicsConfig = field(default_factory=InverseDynamicsConfig)
    predictor: PredictorConfig = field(default_factory=PredictorConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    action_decoder: ActionDecoderConfig = field(default_factory=ActionDecoderConfig)
