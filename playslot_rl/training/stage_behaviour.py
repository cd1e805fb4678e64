"""Stage 3: the latent policy (with the slot oracle beside it), then the action decoder (paper, "Learning behaviours").

Two `Stage`s for `fit`. The world model is frozen and has labelled the demonstrations before.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import BehaviourStageConfig
from playslot_rl.data.demonstrations import Demonstrations
from playslot_rl.errors import DataError
from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeding import StepGenerators
from playslot_rl.training.stage_regression import HELD_OUT, Examples, RegressionStage, TensorInputs, apply_rows


def _inputs(demos: Demonstrations, config: BehaviourStageConfig) -> list[Tensor]:
    """What the policy clones from, each (M, N, D): parsed slots, and imagined ones."""
    return [demos.slots, demos.imagined] if config.imagined else [demos.slots]


class CloneStage:
    """Clone latents from parsed slots, and from imagined ones with `config.imagined`; the oracle clones real actions.

    Note: the paper clones from parsed slots only. Imagination then feeds the policy slots it never saw; with the
    predicted slots of the same demonstrations among its inputs (still without any action label) it has. Noise on the
    slots (`config.slot_noise`) makes both networks smooth over errors of about that size: 150 demonstrations are few.
    With `config.loss=l1` they learn medians: the scripted experts switch between full speed back and ahead, and a mean
    of both stands still.

    Args:
        policy: trained in place.
        oracle: trained in place on the real actions of all demonstrations, from parsed slots; None for none.
        demos: labelled by the world model.
        config: batch and options.
        held_out: demonstrations that are not trained on, labelled likewise; None for none.

    Raises:
        DataError: an oracle, but no actions.
    """

    def __init__(
        self,
        policy: LatentPolicy,
        oracle: LatentPolicy | None,
        demos: Demonstrations,
        config: BehaviourStageConfig,
        held_out: Demonstrations | None = None,
    ) -> None:
        inputs = _inputs(demos, config)
        self.stages = {
            "policy": RegressionStage(
                "policy",
                BehaviourLoss(policy, config.loss),
                TensorInputs(torch.cat(inputs), config.slot_noise, "policy_noise"),
                demos.latents.repeat(len(inputs), 1),
                config.batch_size,
                checks=_checks(demos) | ({} if held_out is None else _checks(held_out, HELD_OUT)),
                precision=config.precision,
            )
        }
        if oracle is not None:
            if demos.actions is None:
                raise DataError(
                    "behaviour.oracle: got demonstrations without actions, expected some for the slot oracle: "
                    "set behaviour.oracle=false"
                )
            self.stages["oracle"] = oracle_stage(oracle, demos.slots, demos.actions, config, _acted(held_out))

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Policy, and oracle if there is one."""
        return {name: stage.criterion.network for name, stage in self.stages.items()}

    def loss(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        """Cloning error of one batch; the networks share no weights, so the sum trains each as alone."""
        losses = {name: stage.loss(step, generators)["loss"] for name, stage in self.stages.items()}
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
        f"unexplained_parsed{ending}": (TensorInputs(demos.slots), demos.latents),
        f"unexplained_imagined{ending}": (TensorInputs(demos.imagined), demos.latents),
    }


def _acted(demos: Demonstrations | None) -> tuple[Tensor, Tensor] | None:
    return None if demos is None or demos.actions is None else (demos.slots, demos.actions)


class DecoderStage(RegressionStage):
    """Regress real actions of the labelled demonstrations.

    Note: with `config.decoder_inputs=policy` the inputs are the trained policy's outputs, on parsed slots and (with
    `config.imagined`) on imagined ones, which is what the decoder gets at test time; the paper feeds InvDyn's latents.
    `both` takes them all.

    Args:
        decoder: trained in place.
        policy: trained, frozen.
        demos: with actions.
        config: options.
        held_out: demonstrations that are not trained on; None for none. Their actions only measure.

    Raises:
        DataError: no actions, or fewer demonstrations than `config.labelled_demos`.
    """

    def __init__(
        self,
        decoder: ActionDecoder,
        policy: LatentPolicy,
        demos: Demonstrations,
        config: BehaviourStageConfig,
        held_out: Demonstrations | None = None,
    ) -> None:
        def examples(demos: Demonstrations, rows: Tensor) -> Examples:
            if demos.actions is None:
                raise DataError("action decoder: got demonstrations without actions, expected the feature `action`")
            inputs = [] if config.decoder_inputs == "policy" else [demos.latents[rows]]
            if config.decoder_inputs != "inverse_dynamics":
                inputs += [apply_rows(policy, TensorInputs(slots), rows) for slots in _inputs(demos, config)]
            return TensorInputs(torch.cat(inputs)), demos.actions[rows].repeat(len(inputs), 1)

        inputs, actions = examples(demos, demos.labelled(config.labelled_demos))
        decoder.standardise(inputs.plain(torch.arange(len(inputs))))
        acted = None if held_out is None or held_out.actions is None else held_out
        super().__init__(
            "action_decoder",
            ActionDecoderLoss(decoder, config.loss),
            inputs,
            actions,
            config.batch_size,
            held_out=None if acted is None else examples(acted, acted.labelled(len(acted.lengths))),
            stream="decoder",
            precision=config.precision,
        )


def oracle_stage(
    oracle: LatentPolicy,
    slots: Tensor,
    actions: Tensor,
    config: BehaviourStageConfig,
    held_out: tuple[Tensor, Tensor] | None = None,
) -> RegressionStage:
    """The slot oracle's training: real actions (M, A) from parsed slots (M, N, D) of all demonstrations.

    `held_out` are slots and actions of demonstrations that only measure.
    """
    criterion = BehaviourLoss(oracle, config.loss)
    criterion.set_keys(action=keys.ACTION)
    return RegressionStage(
        "oracle",
        criterion,
        TensorInputs(slots, config.slot_noise, "oracle_noise"),
        actions,
        config.batch_size,
        held_out=held_out and (TensorInputs(held_out[0]), held_out[1]),
        precision=config.precision,
    )
