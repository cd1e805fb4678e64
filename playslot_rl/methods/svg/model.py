"""SVG-LP, stochastic video generation with a learned prior (Denton and Fergus, 2018, section 3).

    h_t, k_t = Enc(x_t),   z_t ~ q_t = LSTM_q(h_1..t),   p_t = LSTM_p(h_1..t-1)
    x^_t = Dec(LSTM_f([h_{t-1}, z_t]), k_c),   c = min(t - 1, S),   t = 2 .. T

The posterior sees the frame that is to be predicted, so that z_t carries what the past does not tell. The prior learns
to foresee it. The skip maps k bring in what stands still; past the seed they are those of its last frame, the decoder
never sees a later one.

Training is teacher-forced: h_{t-1} is always of a true frame. At test, predictions are fed back past the seed.

Note: the original takes the skip maps from the last frame but one (the paper says the last). It also leaves BatchNorm
in training mode at test, so that its scores depend on the batch; here `eval()` uses the running statistics, which is
why in training BatchNorm sees the frames of all steps at once instead of step by step.

Shapes: B batch, T frames of a clip, S seed frames, H W image height and width, F width of a frame's code, Z latent,
k decoded steps.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from playslot_rl.frames import normalise
from playslot_rl.methods.svg.method import SVGConfig
from playslot_rl.methods.svg.networks import (
    Decoder,
    Encoded,
    Encoder,
    FramePredictor,
    Gaussian,
    GaussianLSTM,
    State,
    check_image_size,
)
from playslot_rl.methods.video.predictor import check_clip

WEIGHT_STD = 0.02
"""Of convolutional and linear weights before training."""


class TeacherForced(NamedTuple):
    """A pass over true clips: predicted frames (B, k, 3, H, W), float in (0, 1), which of the T - 1 predictions they
    are (B, k), int64, of which i predicts frame i + 1, both from 0; posterior and prior of z_2 .. z_T (B, T - 1, Z).
    """

    predicted: Tensor
    steps: Tensor
    posterior: Gaussian
    prior: Gaussian


class SVG(nn.Module):
    """SVG-LP, a `VideoPredictor` of frames H = W = 4 * 2^levels.

    Raises:
        ValueError: the levels do not fit the image size.

    Examples:
        >>> import torch
        >>> from playslot_rl.methods.svg.method import SVGConfig
        >>> config = SVGConfig(channels=(4, 8), convs=(1, 1), features=8, latent_dim=2, hidden=8)
        >>> model = SVG(config, 16).eval()
        >>> model.predict(torch.rand(2, 5, 3, 16, 16), seed=3).shape
        torch.Size([2, 2, 3, 16, 16])
    """

    infers: bool = True

    def __init__(self, config: SVGConfig, image_size: int) -> None:
        super().__init__()
        check_image_size(image_size, len(config.channels))
        self.config, self.image_size = config, image_size
        self.encoder = Encoder(config.channels, config.convs, config.features)
        self.decoder = Decoder(config.channels, config.convs, config.features)
        self.predictor = FramePredictor(config.features, config.latent_dim, config.hidden, config.layers)
        self.posterior = GaussianLSTM(config.features, config.latent_dim, config.hidden)
        self.prior = GaussianLSTM(config.features, config.latent_dim, config.hidden)
        self.apply(_initialise)

    def forward(
        self, frames: Tensor, seed: int, generator: torch.Generator, steps: Tensor | None = None
    ) -> TeacherForced:
        """Predict every frame of clips (B, T, 3, H, W) but the first from true ones, z sampled from the posterior.

        `steps` (B, k), int64, are those of the T - 1 predictions that are decoded; None decodes all. The skip maps of
        the
        seed's last frame serve all later ones. A ValueError where no frame is past the seed, or frames are of another
        size.
        """
        check_clip(frames, seed)
        batch, count = frames.shape[:2]
        encoded = self.encoder(normalise(frames).flatten(0, 1))
        codes = encoded.code.unflatten(0, (batch, count))
        posterior, prior = self.distributions(codes)
        outputs, _ = self.predictor(codes[:, :-1], posterior.sample(generator))
        if steps is None:
            steps = torch.arange(count - 1, device=frames.device).expand(batch, -1)
        clip = torch.arange(batch, device=frames.device)[:, None]
        skips = encoded.rows((clip * count + steps.clamp(max=seed - 1)).flatten())
        predicted = self.decoder(outputs[clip, steps].flatten(0, 1), skips).unflatten(0, tuple(steps.shape))
        return TeacherForced(predicted, steps, posterior, prior)

    def distributions(self, codes: Tensor) -> tuple[Gaussian, Gaussian]:
        """Posterior and prior of z_2 .. z_T (B, T - 1, Z), from codes of true frames (B, T, F), T at least 2."""
        return self.posterior(codes[:, 1:])[0], self.prior(codes[:, :-1])[0]

    def encode(self, frames: Tensor) -> Tensor:
        """Codes (B, M, F) of frames (B, M, 3, H, W), uint8 or float [0, 1]; frame by frame, for the sake of memory."""
        return torch.stack([self.encoder(normalise(frame)).code for frame in frames.unbind(dim=1)], dim=1)

    def predict(self, frames: Tensor, seed: int, donors: Tensor | None = None) -> Tensor:
        """See `VideoPredictor`; z_t is the posterior's mean, within the seed always of the clip's own."""
        check_clip(frames, seed)
        shown = self._see(frames[:, :seed])
        if donors is None:
            future = torch.cat((shown.codes, self.encode(frames[:, seed:])), dim=1)
        elif donors.shape == frames.shape:
            future = self.encode(donors)
        else:
            raise ValueError(f"donors: got {tuple(donors.shape)}, expected the clips' {tuple(frames.shape)}")
        latents = torch.cat((shown.latents, self._means(future)[:, seed - 1 :]), dim=1)
        return self._unroll(shown, latents, frames.shape[1], None)

    def sample(self, frames: Tensor, seed: int, generator: torch.Generator) -> Tensor:
        """As `predict`, but z past the seed is drawn from the learned prior, which sees no true frame there."""
        check_clip(frames, seed)
        shown = self._see(frames[:, :seed])
        return self._unroll(shown, shown.latents, frames.shape[1], generator)

    def _see(self, frames: Tensor) -> _Seed:
        last = self.encoder(normalise(frames[:, -1]))
        codes = last.code[:, None]
        if frames.shape[1] > 1:
            codes = torch.cat((self.encode(frames[:, :-1]), codes), dim=1)
        return _Seed(codes, self._means(codes), last)

    def _means(self, codes: Tensor) -> Tensor:
        """Posterior means of z_2 .. z_M (B, M - 1, Z) from codes (B, M, F); an LSTM takes no empty sequence."""
        if codes.shape[1] == 1:
            return codes.new_zeros(len(codes), 0, self.config.latent_dim)
        means: Tensor = self.posterior(codes[:, 1:])[0].mean
        return means

    def _unroll(self, shown: _Seed, latents: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
        """Predict up to frame T = `count` with given latents (B, M, Z), from M + 1 on with those the prior draws."""
        seed, known = shown.codes.shape[1], latents.shape[1]
        state: State | None = None
        belief: State | None = None
        predicted: list[Tensor] = []
        for step in range(count - 1):
            code = shown.codes[:, step] if step < seed else self.encoder(predicted[-1]).code
            code = code[:, None]
            z = latents[:, step : step + 1]
            if generator is not None:
                prior, belief = self.prior(code, belief)
                z = z if step < known else prior.sample(generator)
            output, state = self.predictor(code, z, state)
            if step >= seed - 1:
                predicted.append(self.decoder(output[:, 0], shown.last.skips))
        return torch.stack(predicted, dim=1)


class _Seed(NamedTuple):
    """What is known of the seed: codes (B, S, F), posterior means (B, S - 1, Z), its last frame."""

    codes: Tensor
    latents: Tensor
    last: Encoded


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
        nn.init.normal_(module.weight, std=WEIGHT_STD)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
