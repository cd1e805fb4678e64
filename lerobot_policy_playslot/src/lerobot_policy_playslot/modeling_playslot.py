"""The policy as LeRobot calls it. Shapes: B environments in lock-step, A action width, H W image height and width."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

from lerobot.policies import PreTrainedPolicy
from torch import Tensor, uint8

from lerobot_policy_playslot.configuration_playslot import NOT_TRAINED_HERE, PlaySlotConfig
from playslot_rl.acting.actor import told_as
from playslot_rl.acting.agent import playslot_actor
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.sharing.folder import WEIGHTS, build_agent, load_weights, require_range, write_weights


class PlaySlotPolicy(PreTrainedPolicy):
    """World model, latent policy and action decoder.

    The policy remembers: it carries SAVi's recurrent state from one `select_action` to the next, one row for each
    environment. `reset` forgets it, and has to be called before new episodes, as LeRobot's programs do. What LeRobot's
    factory passes besides (`dataset_stats`, `dataset_meta`) is not used.
    """

    config_class = PlaySlotConfig
    name = "playslot"

    def __init__(self, config: PlaySlotConfig, **kwargs: Any) -> None:
        del kwargs
        super().__init__(config)
        self.policy_config = config.policy_config()
        self.agent = build_agent(self.policy_config)
        side = self.policy_config.env.image_size
        self._loop = ClosedLoop(playslot_actor(self.agent), side, self.policy_config.resize)

    def reset(self) -> None:
        """Forget the episodes."""
        self._loop.reset()

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Actions (B, A) in [-1, 1] for the frames of the policy's camera, float (B, 3, H, W) in [0, 1]; LeRobot's
        postprocessor gives them in the robot's units. What a policy of several tasks is to do is read of `task`, of
        each environment or of all, at the first frames after a `reset`. A ValueError where there is no such camera or
        task, for frames of another shape, range or kind, and for another number of environments without a `reset`.
        """
        del kwargs
        self.eval()  # as LeRobot's own policies do
        camera = self.policy_config.camera
        camera = camera if camera in batch else camera.rpartition(".")[2]  # renamed to the short name
        if camera not in batch:
            camera = self.policy_config.camera
            had = ", ".join(sorted(name for name in batch if name.startswith("observation."))) or "none"
            raise ValueError(
                f'observation: got {had}, expected {camera}: rename yours by --rename_map=\'{{"yours": "{camera}"}}\''
            )
        frames = batch[camera]
        if not isinstance(frames, Tensor) or not (frames.is_floating_point() or frames.dtype == uint8):
            got = getattr(frames, "dtype", type(frames).__name__)
            raise ValueError(f"{camera}: got {got}, expected a tensor of floats in [0, 1], or of bytes (torch.uint8)")
        if frames.is_floating_point() and not bool(((frames >= 0) & (frames <= 1)).all()):
            low, high = frames.min().item(), frames.max().item()
            raise ValueError(f"{camera}: got floats in [{low:g}, {high:g}], expected [0, 1]: divide bytes by 255")
        if self._loop.actor.tasks and not self._loop.begun:
            said: Any = batch.get("task") or ""
            self._loop.actor.tells = told_as(self.policy_config.env, [said] if isinstance(said, str) else said)
        return self._loop.act(frames, camera)

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The next action as a chunk of one, (B, 1, A). It is an agent step: the frames are remembered."""
        return self.select_action(batch, **kwargs)[:, None]

    def forward(self, batch: dict[str, Tensor]) -> NoReturn:
        """Refuse to train; `lerobot-train` is refused before, by the config."""
        raise NotImplementedError(NOT_TRAINED_HERE)

    def get_optim_params(self) -> NoReturn:
        raise NotImplementedError(NOT_TRAINED_HERE)

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Write weights, then the config with their fingerprint; a gathered `state_dict`, as of sharded training, is
        refused."""
        if state_dict is not None:
            raise NotImplementedError(NOT_TRAINED_HERE)
        self.config.fingerprint = write_weights(self.agent, save_directory / WEIGHTS)
        self.config._save_pretrained(save_directory)

    @classmethod
    def _load_as_safetensor(
        cls, model: PlaySlotPolicy, model_file: str, map_location: str, strict: bool
    ) -> PlaySlotPolicy:
        """Load the weights, every one of them, whatever `strict` says, else a CheckpointError; a ValueError for a
        robot's policy without the range of its actions.
        """
        del strict
        require_range(model.policy_config.env, model.config.actions)
        load_weights(model.agent, Path(model_file), model.policy_config)
        model.to(map_location)
        return model
