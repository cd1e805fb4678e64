"""The front door: load a run or a pretrained model, then parse, infer, imagine, decode and act.

    model = playslot_rl.load("runs/demo")
    slots = model.parse(video)                       # frames to object slots
    actions = model.infer_actions(slots)             # what happened between the frames
    future = model.imagine(video[0], actions.z)      # what would happen
    frames = model.decode(future).frames             # what it would look like
    action = model.act(frame)                        # what to do

Frames are accepted as they come: numpy or torch, uint8 [0, 255] or float [0, 1], height-width-channels or
channels-height-width. Everything runs without gradients, in evaluation mode, on the model's device.

Shapes: B batch, T frames, P imagined steps, N slots, D slot width, Z latent-action width, A action width,
H W image height and width. "[B,]" may be there or not; "[N,]" is there with one latent action per slot.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.acting.actor import told_as
from playslot_rl.acting.agent import playslot_actor
from playslot_rl.acting.closed_loop import ClosedLoop, resized
from playslot_rl.acting.imagination import ImaginationEnv, ImaginationSession, Reward, latent_actions
from playslot_rl.config import ExperimentConfig, RenderConfig
from playslot_rl.errors import CheckpointError, require_type
from playslot_rl.frames import as_numbers, normalise, quantise
from playslot_rl.modules.inverse_dynamics import LatentActions
from playslot_rl.modules.savi import Decoded
from playslot_rl.runs import Run
from playslot_rl.runtime.devices import named_device, probed
from playslot_rl.world_model import Agent, WorldModel, module_device

if TYPE_CHECKING:
    from torchrl.envs import TransformedEnv

    from playslot_rl.sharing.folder import SharedPolicyConfig

Array = npt.NDArray[Any] | Tensor


def load(run: str | Path | Run = "pretrained", device: str = "", seed: int = 0) -> PlaySlot:
    """Load a run folder, an exported policy, or a model that ships with the package, `pretrained/ENV` (`pretrained` is
    ButtonPress's). Without a finished `train-policy` it cannot `act`.

    Args:
        device: torch device; empty means a GPU if there is one.
        seed: of sampled initial slots (only models with `initial: gaussian` draw any).

    Raises:
        CheckpointError: there is no such run, or its checkpoints are damaged or do not belong together.

    Examples:
        >>> import playslot_rl
        >>> model = playslot_rl.load("pretrained", device="cpu")
        >>> model.world_model.slot_shape[0]
        4
    """
    from playslot_rl.sharing.folder import is_model_folder

    require_type(run, "run", str, PathLike, Run, expected="a run folder or `pretrained`")
    require_type(seed, "seed", SupportsIndex, expected="a number")
    folder = run.folder if isinstance(run, Run) else Path(run).expanduser()
    if is_model_folder(folder):
        return PlaySlot.from_pretrained(folder, device, seed=seed)
    target = probed(named_device(device))
    opened = run if isinstance(run, Run) else Run.open(run)
    if not opened.has("policy"):
        return PlaySlot(opened.load_world_model(target), None, seed, opened.view.resize)
    from playslot_rl.sharing.run import described

    agent, policy = opened.load_agent(target), described(opened)
    model = PlaySlot(agent.world_model, agent, seed, policy.resize)
    model._policy = policy
    return model


class PlaySlot:
    """A world model, maybe with its agent, without which `act` is refused. Equal calls give equal results, by the
    `seed` of sampled initial slots. Frames of another size are refused, or with `resize` resized by area averaging, as
    those of the training were (`data.resize`).
    """

    def __init__(
        self, world_model: WorldModel, agent: Agent | None = None, seed: int = 0, resize: bool = False
    ) -> None:
        self.world_model = world_model.eval()
        self.agent = None if agent is None else agent.eval()
        self._seed, self._resize = seed, resize
        side = world_model.env.image_size
        self._loop = None if agent is None else ClosedLoop(playslot_actor(agent), image_size=side, seed=seed)
        self._policy: SharedPolicyConfig | None = None

    @classmethod
    def untrained(cls, config: ExperimentConfig | None = None, seed: int = 0) -> PlaySlot:
        """Random weights, for trying out the interface; by default of the sizes of `playslot_rl.testing.tiny_config`.

        Examples:
            >>> PlaySlot.untrained().world_model.latent_shape
            (8,)
        """
        from playslot_rl.testing import tiny_agent

        require_type(config, "config", ExperimentConfig, type(None), expected="an ExperimentConfig, or None")
        agent = tiny_agent(config, seed)
        return cls(agent.world_model, agent, seed)

    @classmethod
    def from_pretrained(
        cls, name: str | Path, device: str = "", revision: str = "", token: str | None = None, seed: int = 0
    ) -> PlaySlot:
        """Load a policy that `playslot export` or `save_pretrained` wrote, from a folder or, where there is none of
        that name, `user/name` on the Hugging Face Hub; `device` and `seed` are as of `load`.

        Args:
            revision: branch, tag or commit on the Hub; empty means main.
            token: None takes HF_TOKEN or what `hf auth login` stored; not needed for public models.

        Raises:
            CheckpointError: the folder is not whole, its files do not belong together, or it is no PlaySlot policy.
            HubError: no such repository or revision, no network, or an error of the Hub.
        """
        from playslot_rl.sharing.folder import load_pretrained

        require_type(name, "name", str, PathLike, expected="a folder, or user/name on the Hub")
        require_type(seed, "seed", SupportsIndex, expected="a number")
        folder, target = Path(name).expanduser(), probed(named_device(device))
        if not folder.is_dir():
            from playslot_rl.hub.pull import pull_policy

            folder = pull_policy(str(name), revision, token=token)
        agent, policy = load_pretrained(folder, target)
        model = cls(agent.world_model, agent, seed, policy.resize)
        model._policy = policy
        return model

    def save_pretrained(self, folder: str | Path) -> None:
        """Write the policy as a new folder that LeRobot loads (`playslot_rl.sharing.folder`).

        What a loaded policy says of its origin is written again; of one that was just trained nothing is known here:
        `playslot export` reads it from the run, with the results for the card. A CheckpointError where the model has no
        policy, an OutputError where the folder cannot be written.
        """
        from dataclasses import replace

        from playslot_rl.sharing.card import make_card
        from playslot_rl.sharing.folder import SharedPolicyConfig, save_pretrained
        from playslot_rl.sharing.run import versions

        agent = self._require_agent("save_pretrained")
        require_type(folder, "folder", str, PathLike, expected="the folder to write")
        path = Path(folder).expanduser()
        known = self._policy or SharedPolicyConfig(resize=self._resize)
        source = {**known.source, "versions": versions()}
        config = replace(known, env=agent.world_model.env, model=agent.world_model.config, source=source)
        save_pretrained(agent, path, config, lambda written: make_card(path.name, written, agent))

    @torch.no_grad()
    def parse(self, frames: Array) -> Tensor:
        """Slots ([B,] [T,] N, D) of frames ([B,] [T,] H, W, 3) or ([B,] [T,] 3, H, W); each clip starts an episode. A
        ValueError for other shapes, and floats outside [0, 1].

        Examples:
            >>> video = np.random.default_rng(0).integers(256, size=(5, 64, 64, 3), dtype=np.uint8)
            >>> PlaySlot.untrained().parse(video).shape
            torch.Size([5, 4, 32])
        """
        pixels = self._frames(frames)
        lead = pixels.shape[:-3]
        if len(lead) > 2:
            raise ValueError(f"frames: got {pixels.ndim} dimensions, expected 3 (a frame), 4 (a clip) or 5 (clips)")
        clips = pixels.reshape((1,) * (2 - len(lead)) + tuple(pixels.shape))
        slots = self.world_model.savi.parse(clips, self._seed)
        return slots.reshape(*lead, *slots.shape[2:])

    @torch.no_grad()
    def infer_actions(self, slots: Array) -> LatentActions:
        """Latent actions between consecutive frames, from slots ([B,] T, N, D) as `parse` gives them, T at least 2: z,
        its mean, prototype and variability ([B,] T-1, [N,] Z), code ([B,] T-1, [N]) and the quantiser's loss. A
        ValueError for other shapes, and for a model of mode `ground_truth`, which infers none.

        Examples:
            >>> model = PlaySlot.untrained()
            >>> actions = model.infer_actions(model.parse(torch.rand(5, 3, 64, 64)))
            >>> actions.z.shape, actions.code.shape
            (torch.Size([4, 8]), torch.Size([4]))
        """
        given = self._slots(slots)
        if given.ndim not in (3, 4) or given.shape[-3] < 2:
            raise ValueError(f"slots: got shape {tuple(given.shape)}, expected ([B,] T, N, D) with at least 2 frames")
        clips = given if given.ndim == 4 else given[None]
        actions: LatentActions = self.world_model.inverse_dynamics(clips)
        if given.ndim == 4:
            return actions
        return actions._replace(**{name: getattr(actions, name)[0] for name in actions._fields if name != "vq_loss"})

    @torch.no_grad()
    def imagine(self, first_frame: Array, actions: Array) -> Tensor:
        """Slots ([B,] P, N, D) of the frames that follow one, ([B,] H, W, 3) or ([B,] 3, H, W), under given latent
        actions.

        Args:
            actions: latent actions, float ([B,] P, [N,] Z), or prototypes by number, integer ([B,] P, [N]); of a model
                of mode `ground_truth` real actions, in the units of the data set.

        Examples:
            >>> model = PlaySlot.untrained()
            >>> frame = torch.rand(3, 64, 64)
            >>> model.imagine(frame, torch.randn(6, 8)).shape
            torch.Size([6, 4, 32])
            >>> model.imagine(frame, torch.tensor([0, 0, 3, 3])).shape
            torch.Size([4, 4, 32])
        """
        z, inverse = latent_actions(self.world_model, actions), self.world_model.inverse_dynamics
        if inverse.config.mode == "ground_truth":
            z = inverse.action_range.to_unit(z)
        batched = z.ndim == len(self.world_model.latent_shape) + 2
        slots = self.parse(first_frame)
        if slots.ndim not in (2, 3) or (slots.ndim == 3 and not batched):
            raise ValueError(f"first_frame: got parsed shape {tuple(slots.shape)}, expected one frame for each z")
        z = z if batched else z[None]
        slots = slots.expand(len(z), -1, -1) if slots.ndim == 2 else slots
        if len(slots) != len(z):
            raise ValueError(f"imagine: got {len(slots)} frames and {len(z)} action sequences, expected equal numbers")
        p, v = inverse.split(z)
        future = self.world_model.predictor.rollout(slots[:, None], p, v)
        return future if batched else future[0]

    @torch.no_grad()
    def decode(self, slots: Array) -> Decoded:
        """Frames and masks of slots (..., N, D): frames (..., 3, H, W), about [0, 1]; rgb (..., N, 3, H, W); and masks
        (..., N, 1, H, W) that sum to one over N.

        Examples:
            >>> PlaySlot.untrained().decode(torch.randn(5, 4, 32)).masks.shape
            torch.Size([5, 4, 1, 64, 64])
        """
        decoded: Decoded = self.world_model.savi.decode(self._slots(slots))
        return decoded

    @torch.no_grad()
    def act(self, frame: Array) -> npt.NDArray[np.float32]:
        """The real action (A,) for an observed frame, (H, W, 3) or (3, H, W), in the units of the demonstrations' data
        set; of our simulators, in [-1, 1]. A CheckpointError where the model has no policy.

        The frames of an episode are given one after the other: SAVi's recurrent state is carried from call to call, so
        `reset` before each episode.

        Examples:
            >>> model = PlaySlot.untrained()
            >>> model.reset()
            >>> [model.act(torch.rand(3, 64, 64)).shape for _ in range(2)]
            [(4,), (4,)]
        """
        self._require_agent("act")
        assert self._loop is not None
        pixels = self._frames(frame)
        if pixels.ndim != 3:
            raise ValueError(f"frame: got shape {tuple(pixels.shape)}, expected one frame, (H, W, 3) or (3, H, W)")
        # On the CPU, where LeRobot's pipeline computes it, too.
        chosen = self._loop.act(pixels[None])[0].float().cpu()
        out: npt.NDArray[np.float32] = self._loop.actor.executed(chosen).numpy()
        return out

    def reset(self, goal: Array | None = None, task: str | None = None) -> None:
        """Forget the episode: the next frame `act` gets is a first one. `task` is what a policy of several is to do, by
        its name or as the data say it, `goal` the image, (H, W, 3) or (3, H, W), that one of `model.policy.goal=true`
        is to reach; both until others are given. Without a policy nothing happens. A ValueError for other tasks or
        shapes, or for a policy that is told or shown none.
        """
        if self._loop is None:
            return
        actor, image = self._loop.actor, None if goal is None else self._frames(goal)
        if image is not None and (not actor.shown_goals or image.ndim != 3):
            got = f"shape {tuple(image.shape)}" if actor.shown_goals else "an image for a policy that is shown none"
            expected = "one image" if actor.shown_goals else "nothing, or one trained with model.policy.goal=true"
            raise ValueError(f"goal: got {got}, expected {expected}")
        if task is not None:
            if not actor.tasks:
                raise ValueError(f"task: got {task!r} for a policy that is told none, expected nothing")
            actor.tells = told_as(self.world_model.env, [task])
        if image is not None:
            actor.goals = lambda seeds: quantise(image).expand(len(seeds), -1, -1, -1)
        self._loop.reset()

    def _require_agent(self, method: str) -> Agent:
        if self.agent is None:
            raise CheckpointError(
                f"{method}: got a world model without a policy; run `playslot train-policy` and load that run"
            )
        return self.agent

    def imagination(
        self, batch_size: Sequence[int] = (), horizon: int = 0, reward: Reward | None = None
    ) -> ImaginationEnv:
        """The world model as a TorchRL environment, see `playslot_rl.acting.imagination.ImaginationEnv`.

        Examples:
            >>> PlaySlot.untrained().imagination([2]).rollout(3)["slots"].shape
            torch.Size([2, 3, 4, 32])
        """
        require_type(horizon, "horizon", SupportsIndex, expected="a number of steps, or 0")
        sizes = as_numbers(batch_size, "batch_size", "a list of numbers, such as [2]")
        if sizes.ndim != 1 or (sizes < 1).any() or (sizes.numel() and sizes.is_floating_point()):
            raise ValueError(f"batch_size: got {batch_size!r}, expected numbers from 1 on, such as [2]")
        generator = self._generator()
        return ImaginationEnv(self.world_model, batch_size, horizon=horizon, generator=generator, reward=reward)

    def session(self) -> ImaginationSession:
        """Imagination step by step: reset from frames or slots, step by latent actions or prototypes, go back."""
        return ImaginationSession(self.world_model, self._generator())

    def simulation(self, render: RenderConfig | None = None) -> TransformedEnv:
        """The simulated task with slots as observation and latent actions as action (`playslot_rl.acting.simulation`),
        drawn as `render` says: use what the training data were drawn with. A CheckpointError where the model has no
        policy, a ConfigError where the task has no simulator.
        """
        decoder, stride = self._require_agent("simulation").action_decoder, self._policy.stride if self._policy else 1
        env = self.world_model.env.every(stride)
        from playslot_rl.acting.simulation import make_simulation_env

        require_type(render, "render", RenderConfig, type(None), expected="a RenderConfig, or None")
        return make_simulation_env(env, render or RenderConfig(), self.world_model, decoder, self._generator())

    def _generator(self) -> torch.Generator:
        return torch.Generator(module_device(self.world_model)).manual_seed(self._seed)

    def _frames(self, frames: Array) -> Tensor:
        """Any accepted layout to float (..., 3, H, W) in [0, 1] on the model's device."""
        pixels = as_numbers(frames, "frames", "pixels as a numpy array or a tensor: decode a video or picture first")
        side, shape = self.world_model.env.image_size, tuple(pixels.shape)
        if shape[-1:] == (3,) and shape[-3:] != (3, side, side):
            pixels = pixels.movedim(-1, -3)
        fits = tuple(pixels.shape[-3:]) == (3, side, side)
        if pixels.ndim < 3 or pixels.shape[-3] != 3 or not (fits or (self._resize and pixels.numel())):
            raise ValueError(
                f"frames: got shape {shape}, expected (..., {side}, {side}, 3) or (..., 3, {side}, {side})"
                + (", or another height and width" if self._resize else "")
            )
        if not pixels.numel():
            raise ValueError(f"frames: got shape {shape}, which holds none, expected at least one frame")
        if pixels.dtype != torch.uint8 and not (
            pixels.is_floating_point() and bool(((pixels >= 0) & (pixels <= 1)).all())
        ):
            values = pixels.double()  # of some integers torch finds no minimum
            low, high = values.min().item(), values.max().item()
            raise ValueError(
                f"frames: got {pixels.dtype} in [{low:g}, {high:g}], expected uint8 in [0, 255] or floats in [0, 1]"
            )
        return normalise((pixels if fits else resized(pixels, side)).to(module_device(self.world_model))).float()

    def _slots(self, slots: Array) -> Tensor:
        given = as_numbers(slots, "slots", "slots as `parse` gives them")
        if tuple(given.shape[-2:]) != self.world_model.slot_shape or not given.numel():
            expected = self.world_model.slot_shape
            raise ValueError(f"slots: got shape {tuple(given.shape)}, expected (..., {expected[0]}, {expected[1]})")
        if not given.is_floating_point():
            raise ValueError(f"slots: got {given.dtype}, expected floats, as `parse` gives them")
        return given.to(module_device(self.world_model)).float()
