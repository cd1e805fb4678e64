"""Stage 3: the latent policy (with the slot oracle beside it), then the action decoder (system.md section 4).

Two `Stage`s for `fit`. The world model is frozen and has labelled the demonstrations before.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import BehaviourStageConfig
from playslot_rl.data.demonstrations import Demonstrations
from playslot_rl.errors import DataError
from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeding import StepGenerators
from playslot_rl.training.stage_regression import RegressionStage, TensorInputs, draw_rows, unexplained


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

    Raises:
        DataError: an oracle, but no actions.
    """

    def __init__(
        self, policy: LatentPolicy, oracle: LatentPolicy | None, demos: Demonstrations, config: BehaviourStageConfig
    ) -> None:
        if oracle is not None and demos.actions is None:
            raise DataError(
                "behaviour.oracle: got demonstrations without actions, expected some for the slot oracle: "
                "set behaviour.oracle=false"
            )
        self.policy, self.oracle, self.demos, self.config = policy, oracle, demos, config
        self.criterion = BehaviourLoss(policy, config.loss)
        self.oracle_stage: RegressionStage | None = None
        if oracle is not None and demos.actions is not None:
            self.oracle_stage = oracle_stage(oracle, demos.slots, demos.actions, config)
        self.inputs = TensorInputs(torch.cat(_inputs(demos, config)), config.slot_noise, "policy_noise")

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Policy, and oracle if there is one."""
        return {"policy": self.policy} | ({"oracle": self.oracle} if self.oracle is not None else {})

    def loss(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        """Cloning error of one batch; the networks share no weights, so the sum trains each as alone."""
        demos = self.demos
        rows = draw_rows(len(self.inputs), self.config.batch_size, generators, "policy", demos.slots.device)
        batch = {
            keys.SLOTS: self.inputs.draw(rows, generators),
            keys.LATENT_ACTION: demos.latents[rows % len(demos.latents)],
        }
        losses = {"policy": self.criterion(TensorDict(batch, [len(rows)]))["loss_policy"]}
        if self.oracle_stage is not None:
            losses["oracle"] = self.oracle_stage.loss(step, generators)["loss"]
        return {"loss": torch.stack(list(losses.values())).sum(), **losses}

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """Unexplained fraction of the latents' variance on the demonstrations, from parsed and from imagined slots."""
        return {
            "unexplained_parsed": unexplained(_apply(self.policy, self.demos.slots), self.demos.latents),
            "unexplained_imagined": unexplained(_apply(self.policy, self.demos.imagined), self.demos.latents),
        }


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

    Raises:
        DataError: no actions, or fewer demonstrations than `config.labelled_demos`.
    """

    def __init__(
        self, decoder: ActionDecoder, policy: LatentPolicy, demos: Demonstrations, config: BehaviourStageConfig
    ) -> None:
        if demos.actions is None:
            raise DataError("action decoder: got demonstrations without actions, expected the feature `action`")
        rows = demos.labelled(config.labelled_demos)
        inputs = [] if config.decoder_inputs == "policy" else [demos.latents[rows]]
        if config.decoder_inputs != "inverse_dynamics":
            inputs += [_apply(policy, slots[rows]) for slots in _inputs(demos, config)]
        latents = torch.cat(inputs)
        decoder.standardise(latents)
        super().__init__(
            "action_decoder",
            ActionDecoderLoss(decoder, config.loss),
            TensorInputs(latents),
            demos.actions[rows].repeat(len(inputs), 1),
            config.batch_size,
            stream="decoder",
        )


def oracle_stage(oracle: LatentPolicy, slots: Tensor, actions: Tensor, config: BehaviourStageConfig) -> RegressionStage:
    """The slot oracle's training: real actions (M, A) from parsed slots (M, N, D) of all demonstrations."""
    criterion = BehaviourLoss(oracle, config.loss)
    criterion.set_keys(action=keys.ACTION)
    return RegressionStage(
        "oracle", criterion, TensorInputs(slots, config.slot_noise, "oracle_noise"), actions, config.batch_size
    )


@torch.no_grad()
def _apply(network: nn.Module, inputs: Tensor) -> Tensor:
    return torch.cat([network(part) for part in inputs.split(1024)])
