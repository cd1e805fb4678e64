"""Config of one training, steps, batch, optimiser, and of the three stages (re-exported by `playslot_rl.config`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

from playslot_rl.config.plain import check
from playslot_rl.config.roles import (
    COUNT,
    NOT_NEGATIVE,
    RATE,
    UNSAID,
    Checked,
    above_zero,
    at_least,
    below_one,
    between,
    role,
    was,
)
from playslot_rl.runtime.precision import Precision as Precision

Execution = Literal["auto", "eager", "graph"]

AFTER_CLONING: Final = (
    "labelled_demos", "decoder_inputs", "decoder_state", "decoder_steps", "decoder_lr", "finetune_steps",
    "finetune_labels", "finetune_lr", "policy_from", "gain",
)  # fmt: skip
"""Settings of the behaviour stage for what comes after the policy."""
DECODING: Final = tuple(
    f"behaviour.{key}"
    for key in ("labelled_demos", "decoder_inputs", "decoder_state", "finetune_steps", "finetune_labels", "finetune_lr")
)
"""Those that other methods share which clone latent actions."""


@dataclass(frozen=True)
class OptimConfig(Checked):
    """Adam and its schedule.

    Attributes:
        lr: base learning rate.
        warmup_steps: linear warm-up.
        schedule: `cosine` to zero over the stage's steps after warm-up, or `constant`.
        grad_clip: maximum gradient norm; 0 switches clipping off.
        accumulate: micro-batches that a process computes one after the other, for want of memory; the result is the
            same but for rounding. It and the number of processes divide the batch.
        ema: decay of a moving average of the weights, which is validated and kept in their place; 0 keeps the last
            weights (paper).
    """

    group = "optim."

    lr: float = field(default=1e-4, metadata=RATE)
    warmup_steps: int = field(default=0, metadata=NOT_NEGATIVE)
    schedule: Literal["cosine", "constant"] = "cosine"
    grad_clip: float = field(default=0.05, metadata=NOT_NEGATIVE)
    accumulate: int = field(default=1, metadata=role("free") | at_least(1))
    ema: float = field(default=0.0, metadata=was(0.0) | below_one("0 (none) to below 1"))


@dataclass(frozen=True)
class StageConfig(Checked):
    """What every training stage has.

    Attributes:
        steps: optimiser steps.
        batch_size: windows per step.
        optim: optimiser.
        precision: `bf16` autocasts SAVi's convolutions and the other networks; `auto` does so where that is quicker,
            and a training goes on as it began.
        checkpoint_every: steps between checkpoints.
        validate_every: steps between validations.
        log_every: steps between log lines.
        execution: `graph` records what a step computes once, as a CUDA graph, and replays it; `eager` launches its
            kernels one by one; `auto` is `graph` on a GPU, wherever the step can be recorded, and `eager` for several
            processes, whose `graph` no two GPUs have tried.
        compile: make kernels of the networks' parts by torch.compile; needs a C++ compiler, and up to a minute
            at the start; `null` compiles SAVi with the full encoder on a GPU, where 2,000 steps are left.
    """

    steps: int = field(default=200_000, metadata=at_least(1))
    batch_size: int = field(default=64, metadata=at_least(1))
    optim: OptimConfig = field(default_factory=OptimConfig)
    precision: Precision = "fp32"
    checkpoint_every: int = field(default=1000, metadata=role("free") | at_least(1))
    validate_every: int = field(default=1000, metadata=role("free") | at_least(1))
    log_every: int = field(default=50, metadata=role("free") | at_least(1))
    compile: bool | None = field(default=None, metadata=role("free") | was(False))
    execution: Execution = field(default="auto", metadata=role("free", "machine"))


def clipped_stage(steps: int, lr: float, schedule: Literal["cosine", "constant"]) -> StageConfig:
    """Batches of 64, without warm-up, gradients clipped at 1."""
    optim = OptimConfig(lr=lr, warmup_steps=0, schedule=schedule, grad_clip=1.0)
    return StageConfig(steps=steps, batch_size=64, optim=optim)


@dataclass(frozen=True)
class SlotsStageConfig(StageConfig):
    """Stage 1, SAVi.

    Attributes:
        clip_frames: frames per clip.
        start_from: run (or `pretrained/ENV`) whose SAVi it starts from; empty is scratch (paper).
        motion_weight: so many times more counts a pixel that moves; 0 (paper) not.
        foreground_weight: so many times more counts a pixel that is not its task's median; 0 (paper) not.
        zoom_steps: so many first steps show single frames, magnified (`playslot_rl.data.zoom`); 0 has none.
        zoom: how many times.
        patience: end once the held-out error has not fallen for so many validations, with the weights of the lowest; 0
            trains all steps.
        segmented_episodes: so many episodes of the task are drawn by its simulator, and every validation scores the
            slots against their segmentation (FG-ARI); 0 does not.
    """

    group = "slots."
    clip_frames: int = field(default=8, metadata=COUNT)
    start_from: str = field(default="", metadata=role("folder"))
    motion_weight: float = field(default=0.0, metadata=was(0.0) | at_least(0, "0 (all pixels alike) or more"))
    foreground_weight: float = field(
        default=0.0, metadata=was(0.0) | UNSAID | at_least(0, "0 (all pixels alike) or more")
    )
    zoom_steps: int = field(default=0, metadata=was(0) | at_least(0, "0 (none) or more"))
    zoom: float = field(default=2.0, metadata=was(2.0) | between(1, 8, "1 (as they are) to 8 times"))
    patience: int = field(default=0, metadata=was(0) | at_least(0, "0 (train all steps) or more"))
    segmented_episodes: int = field(default=4, metadata=role("free") | at_least(0, "0 (no FG-ARI) or more", 1000))


@dataclass(frozen=True)
class DynamicsStageConfig(StageConfig):
    """Stage 2, InvDyn and cOCVP.

    Attributes:
        seed_frames: parsed frames a rollout starts from.
        predicted_frames: frames predicted after the seed.
        from_start: fraction of the clips that start at their episode's first frame, as imagination does.
        teacher_steps: first steps in which every input is a parsed slot (one parallel pass; 0 in the paper).
        decoded_frames: predicted frames decoded for the image loss, drawn at random; 0 decodes all of them.
        image_weight, slot_weight, vq_weight: loss weights (lambda of Eq. "full loss").
        patience: as for the slots, by the slots' error.
    """

    group = "dynamics."
    seed_frames: int = field(default=6, metadata=at_least(1))
    predicted_frames: int = field(default=8, metadata=at_least(1))
    from_start: float = field(default=0.0, metadata=between(0, 1, "a fraction, 0 to 1"))
    teacher_steps: int = field(default=0, metadata=NOT_NEGATIVE)
    decoded_frames: int = field(default=0, metadata=NOT_NEGATIVE)
    image_weight: float = field(default=1.0, metadata=NOT_NEGATIVE)
    slot_weight: float = field(default=1.0, metadata=NOT_NEGATIVE)
    vq_weight: float = field(default=0.25, metadata=NOT_NEGATIVE)
    patience: int = field(default=0, metadata=was(0) | at_least(0, "0 (train all steps) or more"))


@dataclass(frozen=True)
class BehaviourStageConfig(StageConfig):
    """Stage 3, latent policy, action decoder and the slot oracle.

    Attributes:
        labelled_demos: demonstrations whose real actions the action decoder may see.
        parsed: clone from the slots that SAVi parses; false is there to be measured, and leaves the predicted ones.
        imagined: also clone from slots that cOCVP predicts along each demonstration.
        loss: `l2` (paper) or `l1`, of policy, oracle and decoder. Where an expert switches between opposite
            actions, the mean of `l2` is neither, and the policy dithers.
        slot_noise: standard deviation of Gaussian noise added to the slots that policy and oracle clone from (0 in the
            paper); slots have a standard deviation of about 0.7, and a prediction is about 0.03 off.
        shift: policy, oracle and decoder also learn from copies of the demonstrations moved by so many pixels, with the
            same actions (0 in the paper, none): from ten demonstrations a policy learns where it has been.
        shifted_copies: how many, of the eight directions (`playslot_rl.data.views.DIRECTIONS`).
        trim: slot motion, the RMS change of the slots to the next frame, up to which a transition counts as still and
            is left out by all that clone from slots; read off the videos alone. 0 keeps every row (paper).
        trim_pixels: the same for those that clone from frames: the RMS change of the pixels, in [0, 1].
        trim_margin: still transitions kept after each stretch of motion, so that stopping is learned; 0 keeps none.
        whiten: clone the latents in whitened coordinates (`playslot_rl.modules.whitening`), where each direction that
            they vary in weighs the same; false clones them as they are (paper).
        decoder_inputs: `inverse_dynamics` (InvDyn's latents; paper), `policy` (the policy's outputs) or `both`.
        decoder_state: the decoder also reads the slots, a_t = D_a(z_t, S_t), of LAPO and CADDY the policy's features:
            the same change of the image asks for different actions in different places. From few labels that is not
            learned: a decoder of their first half is first tried on the second, with slots and without. False
            reads z_t alone (paper).
        decoder_steps: optimiser steps of the action decoder.
        decoder_lr: its base learning rate; the rest of `optim` is shared.
        finetune_steps: optimiser steps after that, of policy and decoder together, on the labelled rows' actions; the
            policy goes on cloning all rows meanwhile. 0 has none (paper).
        finetune_labels: labelled demonstrations from which on that is done: with five the closed loop loses by it.
        finetune_lr: their base learning rate.
        policy_from: run whose finished policy training is taken over where only what follows it differs; otherwise one
            is trained here.
        oracle: also train the slot oracle (same network on the real actions of all demos).
        gain: the policy acts on predicted slots, corrected by this share of the parsed ones' difference (1: paper).
    """

    group = "behaviour."
    labelled_demos: int = field(default=50, metadata=at_least(1))
    parsed: bool = field(default=True, metadata=was(True))
    imagined: bool = True
    loss: Literal["l2", "l1"] = "l2"
    slot_noise: float = field(default=0.0, metadata=at_least(0, "0 (none) or more"))
    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    shifted_copies: int = field(default=8, metadata=between(1, 8, "1 to 8"))
    trim: float = field(default=0.0, metadata=was(0.0) | at_least(0, "0 (keep all) or more"))
    trim_pixels: float = field(default=0.0, metadata=was(0.0) | between(0, 1, "0 (keep all) to 1"))
    trim_margin: int = field(default=2, metadata=was(2) | at_least(0, "0 or more"))
    whiten: bool = field(default=False, metadata=was(False))
    decoder_inputs: Literal["inverse_dynamics", "policy", "both"] = "inverse_dynamics"
    decoder_state: bool = field(default=False, metadata=was(False))
    decoder_steps: int = field(default=2000, metadata=at_least(1))
    decoder_lr: float = field(default=2e-4, metadata=above_zero(largest=1e40))
    finetune_steps: int = field(default=0, metadata=was(0) | at_least(0, "0 (none) or more"))
    finetune_labels: int = field(default=10, metadata=was(10) | at_least(1))
    finetune_lr: float = field(default=2e-4, metadata=was(2e-4) | above_zero(largest=1e40))
    policy_from: str = field(default="", metadata=role("machine", "folder"))
    oracle: bool = True
    gain: float = field(default=1.0, metadata=UNSAID | between(0, 1, "0 to 1"))

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self.parsed or self.imagined, "behaviour.parsed", self.parsed, "true, or behaviour.imagined=true")
