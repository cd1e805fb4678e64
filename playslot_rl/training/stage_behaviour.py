"""Stage 3: the latent policy (with the slot oracle beside it), then the action decoder (paper, "Learning behaviours").

`Stage`s for `fit`. The world model is frozen and has labelled the demonstrations before. Other methods that clone
latent actions decode them by the same: their slots are what their policy makes of a frame (`modules.policy.Decides`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, Final

import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import BehaviourStageConfig
from playslot_rl.config.stages import AFTER_CLONING
from playslot_rl.data.demonstrations import Demonstrations
from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.policy import Decides, LatentPolicy
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.training.fit import Part
from playslot_rl.training.stage import Stage
from playslot_rl.training.stage_regression import (
    HELD_OUT,
    Examples,
    Inputs,
    PairedInputs,
    RegressionStage,
    TensorInputs,
    apart,
    apply_rows,
    together,
)

VALIDATED: Final = 2048
"""So many rows of each kind are looked at in a validation, evenly spread: all rows of thousands of demonstrations, four
times over, would cost more than the training between two validations.
"""

PAYS: Final = 0.85
"""Largest error of a decoder with slots, over one without, at which the slots are trusted.

Acting leaves the demonstrations' states, where what few labels have taught about slots does harm: on easy BlockPush
0.93 (25 labels) costs eight points of success, 0.78 (100 labels) brings four (docs/notebook/labels.md).
"""


def cloning_settings(config: BehaviourStageConfig) -> BehaviourStageConfig:
    """The settings that decide the policy itself; labels and decoder, which come after it, are at their defaults.

    The same policy serves any number of labels, so that a half-finished or copied training is told by these alone.
    """
    plain = BehaviourStageConfig()
    return replace(config, **{name: getattr(plain, name) for name in AFTER_CLONING})


@dataclass(frozen=True)
class SeenSlots:
    """What policy and decoder see of demonstrations: parsed slots (`config.parsed`), imagined ones (`config.imagined`).

    They are (I, N, D) in parts, the parsed ones first; `rows` is the transition of each, int64 (I,), `told` what a
    policy is told there (I, ...).
    """

    slots: tuple[Tensor, ...]
    rows: Tensor
    told: Tensor | None = None

    @classmethod
    def of(cls, demos: Demonstrations, config: BehaviourStageConfig, horizon: int | None) -> SeenSlots:
        """Look at what `config` says of demonstrations, and at what the predictor imagines only up to `horizon` steps
        after the first frame; None for as long as there are.
        """
        rows = torch.arange(len(demos.slots), device=demos.slots.device)
        if not config.imagined:
            return cls((demos.slots,), rows, demos.told)
        far = rows if horizon is None else rows[demos.step <= horizon]
        imagined = demos.imagined if len(far) == len(rows) else demos.imagined[far]
        slots, rows = ((imagined,), far) if not config.parsed else ((demos.slots, imagined), torch.cat((rows, far)))
        return cls(slots, rows, None if demos.told is None else demos.told[rows])

    def inputs(self, noise: float = 0.0, stream: str = "noise") -> Inputs:
        return PairedInputs.told(TensorInputs(self.slots, noise, stream), self.told, noise)


class CloneStage:
    """Clone latents from parsed slots, and from imagined ones with `config.imagined`; the oracle clones real actions.

    Note: the paper clones from parsed slots only. Imagination then feeds the policy slots it never saw; with the
    predicted slots of the same demonstrations among its inputs (still without any action label) it has, up to the
    horizon the predictor was trained on: beyond it they say little of what happened. Noise on the
    slots (`config.slot_noise`) makes both networks smooth over errors of about that size: 150 demonstrations are few.
    With `config.loss=l1` they learn medians: the scripted experts switch between full speed back and ahead, and a mean
    of both stands still.

    Args:
        demos, held_out: labelled by the world model; the held-out ones are not trained on.
        horizon: steps that the predictor was trained to roll out; None for any number.

    Raises:
        DataError: an oracle, but no actions.
    """

    separate = True
    """The oracle's gradients, of real actions, are clipped apart: they would change the policy, which sees none."""

    def __init__(
        self,
        policy: LatentPolicy,
        oracle: LatentPolicy | None,
        demos: Demonstrations,
        config: BehaviourStageConfig,
        held_out: Demonstrations | None = None,
        horizon: int | None = None,
    ) -> None:
        if policy.whitening is not None:
            policy.whitening.fit(demos.latents)
        seen = SeenSlots.of(demos, config, horizon)
        self.stages = {
            "policy": RegressionStage(
                "policy",
                BehaviourLoss(policy, config.loss),
                seen.inputs(config.slot_noise, "policy_noise"),
                demos.latents[seen.rows],
                config.batch_size,
                checks=_checks(demos) | ({} if held_out is None else _checks(held_out, HELD_OUT)),
                validated=VALIDATED,
                precision=config.precision,
            )
        }
        if oracle is not None:
            acted = _acted(held_out)
            measured = None if acted is None else (acted.slots, acted.require_actions(), acted.told)
            actions = demos.require_actions()
            self.stages["oracle"] = oracle_stage(oracle, demos.slots, actions, config, measured, demos.told)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {name: stage.criterion.network for name, stage in self.stages.items()}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        return together({name: stage.batch(step, generators) for name, stage in self.stages.items()})

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        """Cloning error of one batch; the networks share no weights, so the sum trains each as alone."""
        losses = {name: stage.loss(apart(batch, name), step, generators)["loss"] for name, stage in self.stages.items()}
        return {"loss": torch.stack(list(losses.values())).sum(), **losses}

    def validate(self, step: int) -> Mapping[str, float]:
        """Unexplained fraction of variance: of the latents, from parsed and from imagined slots (`unexplained_parsed`,
        `unexplained_imagined`), and of the oracle's actions (`oracle_unexplained`); on held-out demonstrations, too.
        """
        values = dict(self.stages["policy"].validate(step))
        if "oracle" in self.stages:
            values |= {f"oracle_{name}": value for name, value in self.stages["oracle"].validate(step).items()}
        return values


def _checks(demos: Demonstrations, ending: str = "") -> dict[str, Examples]:
    return {
        f"unexplained_{name}{ending}": (PairedInputs.told(TensorInputs(slots), demos.told), demos.latents)
        for name, slots in (("parsed", demos.slots), ("imagined", demos.imagined))
    }


def _acted(demos: Demonstrations | None) -> Demonstrations | None:
    """Held-out demonstrations whose actions can measure, if there are any."""
    return None if demos is None or demos.actions is None else demos


class DecoderStage(RegressionStage):
    """Regress real actions of the labelled demonstrations from latents, and from slots where the decoder reads them;
    the actions of held-out ones only measure.

    Note: with `config.decoder_inputs=policy` the inputs are the trained policy's outputs, on parsed slots and (with
    `config.imagined`) on imagined ones, which is what the decoder gets at test time; the paper feeds InvDyn's latents.
    `both` takes them all.

    Raises:
        DataError: no actions, or fewer demonstrations than `config.labelled_demos`.
    """

    @classmethod
    def trial(
        cls,
        decoder: ActionDecoder,
        policy: Decides,
        demos: Demonstrations,
        config: BehaviourStageConfig,
        horizon: int | None = None,
    ) -> DecoderStage | None:
        """A copy of the decoder on the first half of the labelled demonstrations, measured on the second: see
        `slots_pay`. Where it will decode tasks of which none is labelled, the halves are of other tasks: what slots
        tell in one may mislead in another. None where a half has no rows: one demonstration or task, or trimming,
        leaves nothing to measure on."""
        labelled = demos.take(demos.labelled(config.labelled_demos))
        second = labelled.episode >= (config.labelled_demos + 1) // 2
        if demos.task is not None and labelled.task is not None:
            taught = labelled.task.unique()
            if len(taught) < len(demos.task.unique()):
                second = torch.isin(labelled.task[:, 0], taught[(len(taught) + 1) // 2 :])
        if second.all() or not second.any():
            return None
        tried = deepcopy(decoder)
        tried.trusts_slots.fill_(True)
        return cls(tried, policy, labelled.take(~second), config, labelled.take(second), horizon)

    def slots_pay(self) -> bool:
        """Whether the actions' mean absolute error on `held_out` is clearly (`PAYS`) less with slots than without."""
        inputs, actions = self.checks[f"unexplained{HELD_OUT}"]
        z, slots = inputs.plain(torch.arange(len(inputs), device=actions.device))
        decoder = self.criterion.network.eval()
        decoder.get_buffer("trusts_slots").fill_(True)  # a trial that was begun before may have stored otherwise
        with torch.no_grad():
            seeing, blind = ((decoder(z, seen) - actions).abs().mean() for seen in (slots, None))
        return bool(seeing <= PAYS * blind)

    def __init__(
        self,
        decoder: ActionDecoder,
        policy: Decides,
        demos: Demonstrations,
        config: BehaviourStageConfig,
        held_out: Demonstrations | None = None,
        horizon: int | None = None,
    ) -> None:
        def examples(demos: Demonstrations, noise: float) -> tuple[Tensor, Examples]:
            actions = demos.require_actions()
            latents, slots, rows = [], [], []
            if config.decoder_inputs != "policy":
                every = torch.arange(len(demos.slots), device=demos.slots.device)
                latents, slots, rows = [demos.latents], [demos.slots], [every]
            if config.decoder_inputs != "inverse_dynamics":
                seen = SeenSlots.of(demos, config, horizon)
                said = apply_rows(policy.decide, seen.inputs(), torch.arange(len(seen.rows), device=seen.rows.device))
                latents, slots, rows = [*latents, said], [*slots, *seen.slots], [*rows, seen.rows]
            z = torch.cat(latents)
            state = [TensorInputs(torch.cat(slots), noise, "decoder_noise")] if decoder.reads_slots else []
            return z, (PairedInputs(TensorInputs(z), *state), actions[torch.cat(rows)])

        z, (inputs, actions) = examples(demos.take(demos.labelled(config.labelled_demos)), config.slot_noise)
        decoder.standardise(z)
        acted = _acted(held_out)
        super().__init__(
            "action_decoder",
            ActionDecoderLoss(decoder, config.loss),
            inputs,
            actions,
            config.batch_size,
            held_out=None if acted is None else examples(acted, 0.0)[1],
            validated=VALIDATED,
            stream="decoder",
            precision=config.precision,
        )


class JointStage:
    """Policy and decoder together on real actions, L_a(D_a(f_pi(S_t))), while the policy goes on cloning (`clone`): +
    L_pi; where the decoder trusts the state, L_a(D_a(f_pi(S_t), S_t)) too.

    Note: not in the papers, whose decoder is trained beside a finished policy. The cloning term keeps the policy's
    latents what the predictor understands.

    Args:
        labelled: what the policy observes, and real actions.
        measured: the same of held-out demonstrations.
    """

    def __init__(
        self,
        clone: RegressionStage,
        decoder: ActionDecoder,
        labelled: Examples,
        measured: Examples | None,
        config: BehaviourStageConfig,
    ) -> None:
        policy: Any = clone.criterion.network
        self.clone, self.policy, self.decoder = clone, policy, decoder
        # In imagination the decoder is given no slots.
        networks = [*([_Both(policy, decoder)] if decoder.acts_on_slots else []), _Both(policy, decoder, blind=True)]

        def acting(network: _Both) -> RegressionStage:
            criterion = BehaviourLoss(network, config.loss)
            criterion.set_keys(observation=clone.criterion.tensor_keys.observation, action=keys.ACTION)
            return RegressionStage(
                "finetune", criterion, *labelled, config.batch_size, held_out=measured, validated=VALIDATED,
                precision=config.precision,
            )  # fmt: skip

        self.acting = [acting(network) for network in networks]

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"policy": self.policy, "action_decoder": self.decoder}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        """Labelled rows, which both ways of acting share, and those that the policy clones."""
        return together(
            {"acting": self.acting[0].batch(step, generators), "cloning": self.clone.batch(step, generators)}
        )

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        labelled = apart(batch, "acting")
        action = torch.stack([part.loss(labelled, step, generators)["loss"] for part in self.acting]).sum()
        latent = self.clone.loss(apart(batch, "cloning"), step, generators)["loss"]
        return {"loss": action + latent, "action": action, "latent": latent}

    def validate(self, step: int) -> Mapping[str, float]:
        return self.acting[0].validate(step)


class FinetuneStage(JointStage):
    """`JointStage` on slots. Raises DataError: no actions, or fewer demonstrations than `config.labelled_demos`."""

    def __init__(
        self,
        clone: RegressionStage,
        decoder: ActionDecoder,
        demos: Demonstrations,
        config: BehaviourStageConfig,
        held_out: Demonstrations | None = None,
        horizon: int | None = None,
    ) -> None:
        def examples(demos: Demonstrations, noise: float) -> Examples:
            actions = demos.require_actions()
            seen = SeenSlots.of(demos, config, horizon)
            return seen.inputs(noise, "finetune_noise"), actions[seen.rows]

        acted = _acted(held_out)
        labelled = examples(demos.take(demos.labelled(config.labelled_demos)), config.slot_noise)
        super().__init__(clone, decoder, labelled, None if acted is None else examples(acted, 0.0), config)


class _Both(nn.Module):
    def __init__(self, policy: Any, decoder: ActionDecoder, blind: bool = False) -> None:
        super().__init__()
        self.policy, self.decoder, self.blind = policy, decoder, blind
        self.tasks, self.goal = getattr(policy, "tasks", 0), getattr(policy, "goal", False)

    def forward(self, observed: Tensor, *told: Tensor) -> Tensor:
        features = self.policy.features(observed, *told)
        out: Tensor = self.decoder(self.policy.decide(features, *told), None if self.blind else features)
        return out


def after_cloning(
    decoder: ActionDecoder,
    policy: Decides,
    demos: Demonstrations,
    config: BehaviourStageConfig,
    part: Callable[[str, Stage, int, float], Part],
    finetune: Callable[[], JointStage],
    held_out: Demonstrations | None = None,
    horizon: int | None = None,
) -> Iterator[Part]:
    """What follows the policy: the decoder, after a trial of whether the state pays, and both together.

    Args:
        part: makes a training of its folder, stage, steps and learning rate.
    """
    if decoder.reads_slots:
        decoder.trusts_slots.fill_(False)  # one demonstration cannot tell
        trial = DecoderStage.trial(decoder, policy, demos, config, horizon)
        if trial is not None:
            yield part("decoder_trial", trial, -(-config.decoder_steps // 2), config.decoder_lr)
            decoder.trusts_slots.fill_(trial.slots_pay())
    stage = DecoderStage(decoder, policy, demos, config, held_out, horizon)
    yield part("decoder", stage, config.decoder_steps, config.decoder_lr)
    if config.finetune_steps and config.labelled_demos >= config.finetune_labels:
        yield part("finetune", finetune(), config.finetune_steps, config.finetune_lr)


def oracle_stage(
    oracle: LatentPolicy,
    slots: Tensor,
    actions: Tensor,
    config: BehaviourStageConfig,
    held_out: tuple[Tensor, Tensor, Tensor | None] | None = None,
    told: Tensor | None = None,
    name: str = "oracle",
) -> RegressionStage:
    """The slot oracle's training: real actions (M, A) from parsed slots (M, N, D) of all demonstrations, and what it is
    told (M, ...) of what to do; the held-out ones only measure. `name` is of its losses and its noise.
    """
    criterion = BehaviourLoss(oracle, config.loss)
    criterion.set_keys(action=keys.ACTION)
    return RegressionStage(
        name,
        criterion,
        PairedInputs.told(TensorInputs(slots, config.slot_noise, f"{name}_noise"), told, config.slot_noise),
        actions,
        config.batch_size,
        held_out=held_out and (PairedInputs.told(TensorInputs(held_out[0]), held_out[2]), held_out[1]),
        validated=VALIDATED,
        precision=config.precision,
    )
