"""CADDY (Menapace et al., 2021, "Playable Video Generation"): discrete actions found in videos, and the next frame.

    s_t, m_t = E(x_t)
    d_t, p_t, a_t, v_t = A(s_t m_t, s_{t+1} m_{t+1})            what happened from frame t to the next
    y_{t+1} = R(s_t, a_t, v_t),   x^_{t+1} = G(y_{t+1})         s_t of the true x_t up to S, then of x^_t

In the warm-up nothing is predicted: G reconstructs x_t from conv(s_t), and R, given true states throughout, learns to
give conv(s_{t+1}). At test d_t is the mean, a_t the argmax, and v_t inferred or zero.

Note: the original shows 4 true frames at test and has v = 0; PlaySlot's comparison shows 6 and leaves v unsaid, hence
`variability`. The original samples at test.

Note: the generated frames in which actions are looked for again begin with the true first one, so that there are as
many moves as between the real ones.

Shapes: B batch, T frames, S seed frames, H W image height and width, C channels of a state of H/8 x W/8, K actions,
Z latent dim. Times count frames from 0. Frames are [0, 1] at the borders and [-1, 1] inside.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from playslot_rl.methods.caddy.action import (
    ActionInformation,
    ActionNetwork,
    Gaussian,
    Latents,
    Moves,
    chosen,
    gumbel_softmax,
)
from playslot_rl.methods.caddy.method import CADDYConfig
from playslot_rl.methods.caddy.networks import Dynamics, Encoder, Generator, Pyramid, inside
from playslot_rl.methods.video.predictor import check_clip


class Generated(NamedTuple):
    """n of the T-1 frames after a clip's first, generated, and what E makes of them.

    Attributes:
        times: of the n frames, 1 to T-1, rising.
        frames: at a quarter, a half and the full resolution, each (B, n, 3, h, w) in (-1, 1).
        s, attended: states s and s m, each (B, n, C, H/8, W/8).
        y: what R gave for all frames after the first (B, T-1, C', H/8, W/8).
    """

    times: tuple[int, ...]
    frames: Pyramid
    s: Tensor
    attended: Tensor
    y: Tensor


class Rollout(NamedTuple):
    """What the loss of a clip is made of.

    Attributes:
        generated: the frames in place of the real ones.
        s: states of the real ones (B, T, C, H/8, W/8).
        moves: between the real ones, T-1 of them.
        real, again: probabilities (B, n', K) of the actions between real frames, and between generated ones at the
            same times; n' is 0 where no two consecutive frames were generated.
        codes: conv(s) of the frames after the first (B, T-1, C', H/8, W/8) in the warm-up, else None.
    """

    generated: Generated
    s: Tensor
    moves: Moves
    real: Tensor
    again: Tensor
    codes: Tensor | None


class CADDY(nn.Module):
    """All of CADDY; a `VideoPredictor`. `variability`, v in `predict`, may be set. A ValueError for an image size that
    is no multiple of 16.
    """

    infers = True

    def __init__(self, config: CADDYConfig, image_size: int) -> None:
        super().__init__()
        if image_size < 16 or image_size % 16:
            raise ValueError(f"image_size: got {image_size}, expected a multiple of 16")
        self.config, self.image_size, self.variability = config, image_size, config.variability
        width, k, z = config.encoder[-1], config.actions, config.latent_dim
        self.encoder = Encoder(config.encoder)
        self.action = ActionNetwork(width, 2 * width, z, k, config.centroid_decay)
        self.dynamics = Dynamics(width, k + z, config.dynamics, image_size // 8)
        self.generator = Generator(config.dynamics, config.generator)
        self.pretraining = nn.Conv2d(width, config.dynamics, 3, padding=1)
        self.information = ActionInformation(k, config.information_decay)

    def forward(
        self,
        frames: Tensor,
        seed: int,
        temperature: float,
        noise: torch.Generator,
        wanted: Collection[int] | None = None,
        warmup: bool = False,
    ) -> Rollout:
        """Training pass over clips; in training mode the centroids move.

        Args:
            frames: (B, T, 3, H, W), float [0, 1], T at least 2.
            seed: S; in a shorter clip every frame that R is given is true.
            temperature: of the Gumbel-softmax.
            noise: source of d and of the Gumbel noise.
            wanted: times (1 to T-1) of the frames to generate; those fed back are generated anyway. None: all.
            warmup: reconstruct instead of predicting.

        Raises:
            ValueError: frames of another size, less than two of them, or none wanted.
        """
        self._check(frames)
        steps = frames.shape[1]
        times = frozenset(range(1, steps) if wanted is None else wanted)
        if steps < 2 or not times or not times <= set(range(1, steps)):
            raise ValueError(f"clip: got {steps} frames, {sorted(times)} wanted, expected some of 1 to T-1")
        s, attended = self._encode(inside(frames))
        pose = self.action.pose(attended)
        moves = self.action.moves(_some(pose, 0, -1), _some(pose, 1, None), noise)
        a = gumbel_softmax(moves.logits, temperature, noise)
        v = self.action.variability(a, moves.d)
        codes = None
        if warmup:
            codes = self.pretraining(s[:, 1:].flatten(0, 1)).unflatten(0, (len(s), steps - 1))
            generated = self._reconstruct(s, a, v, codes, sorted(times))
        else:
            generated = self._unroll(s[:, :seed], a, v, times)
        real, again = self._twice(moves, pose, generated, noise)
        self.action.update_centroids(moves.p, moves.d)
        return Rollout(generated, s, moves, real, again, codes)

    @torch.no_grad()
    def predict(self, frames: Tensor, seed: int, donors: Tensor | None = None) -> Tensor:
        """See `VideoPredictor`; in evaluation mode whatever the mode is.

        Moves within the seed are read off the seed, those from its last frame on off `donors`, from their frame S on.
        """
        self._check(frames)
        check_clip(frames, seed)
        if donors is not None and donors.shape != frames.shape:
            raise ValueError(f"donors: got {tuple(donors.shape)}, expected {tuple(frames.shape)} as the clips")
        training = self.training
        self.eval()
        try:
            shown = frames[:, :seed]
            within, after = self.infer(shown), self.infer((frames if donors is None else donors)[:, seed - 1 :])
            latents = Latents(*(torch.cat(parts, dim=1) for parts in zip(within, after, strict=True)))
            if self.variability == "zero":
                latents = latents._replace(v=torch.zeros_like(latents.v))
            return self.rollout(shown, latents)
        finally:
            self.train(training)

    def infer(self, frames: Tensor) -> Latents:
        """Latents between consecutive frames (B, T, 3, H, W), float [0, 1] or uint8; nothing is drawn.

        a is the one-hot argmax and v belongs to the mean direction. For evaluation mode: else BatchNorm sees the batch.
        """
        self._check(frames)
        pose = self.action.pose(self._encode(inside(frames))[1])
        moves = self.action.moves(_some(pose, 0, -1), _some(pose, 1, None))
        a = chosen(moves.p)
        return Latents(a, self.action.variability(a, moves.d), moves.p)

    def rollout(self, seed: Tensor, latents: Latents) -> Tensor:
        """Frames (B, n + 1 - S, 3, H, W) in (0, 1) after the seed's (B, S, 3, H, W), each from its own predictions.

        `latents` are those of all n moves from the first frame on; fewer than S are refused. For evaluation mode.
        """
        self._check(seed)
        shown, moves = seed.shape[1], latents.a.shape[1]
        if moves < shown:
            raise ValueError(f"latents: got {moves} moves, expected at least {shown}, to lead past the seed")
        s, _ = self._encode(inside(seed))
        generated = self._unroll(s, latents.a, latents.v, frozenset(range(shown, moves + 1)))
        return (generated.frames[-1] + 1) / 2

    def _unroll(self, s: Tensor, a: Tensor, v: Tensor, times: Collection[int]) -> Generated:
        """Run R over all moves, from true states (B, S, ...) while there are some and then from its own frames."""
        batch, moves = a.shape[:2]
        memories = self.dynamics.begin(batch)
        ys, done, pyramids, attended = [], [], [], []
        states: list[Tensor] = []
        for t in range(moves):
            given = s[:, t] if t < s.shape[1] else states[-1][:, 0]
            y, memories = self.dynamics(given, a[:, t], v[:, t], memories)
            ys.append(y)
            if t + 1 in times or s.shape[1] <= t + 1 < moves:
                pyramid: Pyramid = self.generator(y)
                own, own_attended = self._encode(pyramid[-1][:, None])
                done.append(t + 1)
                pyramids.append(pyramid)
                states.append(own)
                attended.append(own_attended)
        quarter, half, full = (torch.stack(level, dim=1) for level in zip(*pyramids, strict=True))
        return Generated(
            tuple(done), (quarter, half, full), torch.cat(states, 1), torch.cat(attended, 1), torch.stack(ys, dim=1)
        )

    def _reconstruct(self, s: Tensor, a: Tensor, v: Tensor, codes: Tensor, times: Sequence[int]) -> Generated:
        """Generate frames from their own codes (B, T-1, ...), and run R over true states (B, T, ...)."""
        memories, ys = self.dynamics.begin(len(s)), []
        for t in range(a.shape[1]):
            y, memories = self.dynamics(s[:, t], a[:, t], v[:, t], memories)
            ys.append(y)
        some = at_times(codes, [time - 1 for time in times])
        quarter, half, full = (x.unflatten(0, some.shape[:2]) for x in self.generator(some.flatten(0, 1)))
        own, attended = self._encode(full)
        return Generated(tuple(times), (quarter, half, full), own, attended, torch.stack(ys, dim=1))

    def _twice(
        self, moves: Moves, pose: Gaussian, generated: Generated, noise: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Probabilities (B, n', K) of the actions between real frames, and between those generated in their place."""
        own = self.action.pose(generated.attended)
        mean, var = (torch.cat((x[:, :1], y), dim=1) for x, y in zip(pose, own, strict=True))
        times = (0, *generated.times)
        first = [i for i in range(len(times) - 1) if times[i + 1] == times[i] + 1]
        second = [i + 1 for i in first]
        before, after = (Gaussian(at_times(mean, some), at_times(var, some)) for some in (first, second))
        return at_times(moves.p, [times[i] for i in first]), self.action.moves(before, after, noise).p

    def _encode(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Frames (B, T, 3, H, W) in [-1, 1] to states s and s m, each (B, T, C, H/8, W/8), float32."""
        s, m = self.encoder(x.flatten(0, 1))
        return s.float().unflatten(0, x.shape[:2]), (s * m).float().unflatten(0, x.shape[:2])

    def _check(self, frames: Tensor) -> None:
        expected = (3, self.image_size, self.image_size)
        if frames.ndim != 5 or frames.shape[2:] != expected:
            raise ValueError(f"frames: got shape {tuple(frames.shape)}, expected (B, T, {expected})")


def _some(pose: Gaussian, first: int, last: int | None) -> Gaussian:
    return Gaussian(pose.mean[:, first:last], pose.var[:, first:last])


def at_times(x: Tensor, times: Sequence[int]) -> Tensor:
    """(B, T, ...) at some times; an index made of a list would have the host wait for a GPU."""
    return torch.stack([x[:, time] for time in times], dim=1) if times else x[:, :0]
