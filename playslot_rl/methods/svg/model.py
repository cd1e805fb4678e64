"""SVG-LP, stochastic video generation with a learned prior (Denton and Fergus, 2018, section 3 and appendix).

    h_t, k_t = Enc(x_t),   z_t ~ q_t = N(mu, sigma^2) = LSTM_q(h_1..t),   p_t = N(mu, sigma^2) = LSTM_p(h_1..t-1)
    x^_t = Dec(LSTM_f([h_{t-1}, z_t]), k_c),   c = min(t - 1, S),   t = 2 .. T

The posterior sees the frame that is to be predicted, so that z_t carries what the past does not tell. The prior learns
to foresee it. The skip maps k bring in what stands still; past the seed they are those of its last frame, the decoder
never sees a later one.

A level is a group of 3x3 convolutions, each with BatchNorm and LeakyReLU. The encoder halves the resolution after each
level, the decoder doubles it before each and joins the encoder's map of the same resolution. At the bottom are 4x4
pixels, so that G levels belong to frames of 4 * 2^G pixels: 64 for the four of the paper. The LSTMs run in float32,
whatever the convolutions do.

Training is teacher-forced: h_{t-1} is always of a true frame. At test, predictions are fed back past the seed.

Note: the original takes the skip maps from the last frame but one (the paper says the last). It also leaves BatchNorm
in training mode at test, so that its scores depend on the batch; here `eval()` uses the running statistics, which is
why in training BatchNorm sees the frames of all steps at once instead of step by step.

Shapes: B batch, T frames of a clip, S seed frames, M steps, H W image height and width, F width of a frame's code, Z
latent, k decoded steps, G levels, C_i channels of level i (from 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl.config.plain import check
from playslot_rl.frames import normalise
from playslot_rl.methods.svg.method import SVGConfig
from playslot_rl.methods.video.predictor import check_clip
from playslot_rl.runtime.shares import own_noise

BOTTOM = 4
"""Pixels a side at the lowest resolution."""
SLOPE = 0.2
"""Of LeakyReLU."""
State = tuple[Tensor, Tensor]
"""Hidden and cell state of an LSTM (layers, B, hidden)."""


class Encoded(NamedTuple):
    """A frame's code h (B, F) in (-1, 1), and its skip maps k, one of each level (B, C_i, H / 2^i, W / 2^i)."""

    code: Tensor
    skips: list[Tensor]

    def rows(self, index: Tensor) -> list[Tensor]:
        """Skip maps of some of the B frames, by int64 numbers (M,): (M, C_i, H / 2^i, W / 2^i)."""
        return [skip[index] for skip in self.skips]


def check_image_size(image_size: int, levels: int) -> None:
    """Refuse a resolution that does not end in 4x4 pixels."""
    fitting = BOTTOM * 2**levels
    check(image_size == fitting, "image_size", image_size, f"{fitting}, for {levels} widths in baselines.svg.channels")


class Encoder(nn.Module):
    """Enc: levels of convolutions with max-pooling between them, then one 4x4 convolution to a vector."""

    def __init__(self, channels: Sequence[int], convs: Sequence[int], features: int) -> None:
        super().__init__()
        ins = (3, *channels[:-1])
        self.levels = nn.ModuleList(
            _group([before, *[width] * count]) for before, width, count in zip(ins, channels, convs, strict=True)
        )
        self.bottom = nn.Sequential(nn.Conv2d(channels[-1], features, BOTTOM), nn.BatchNorm2d(features), nn.Tanh())

    def forward(self, frames: Tensor) -> Encoded:
        """Frames (B, 3, H, W), float [0, 1], to codes and skip maps; a ValueError where the levels ask for another
        size.
        """
        for side in frames.shape[-2:]:
            check_image_size(side, len(self.levels))
        x, skips = frames, []
        for level in self.levels:
            x = level(x)
            skips.append(x)
            x = F.max_pool2d(x, 2)
        return Encoded(self.bottom(x).flatten(1).float(), skips)


class Decoder(nn.Module):
    """Dec: the encoder's mirror image, with twice the channels where a skip map joins.

    The highest level's last convolution is the one to colours, which does not take its only one from it.
    """

    def __init__(self, channels: Sequence[int], convs: Sequence[int], features: int) -> None:
        super().__init__()
        top = nn.ConvTranspose2d(features, channels[-1], BOTTOM)
        self.bottom = nn.Sequential(top, nn.BatchNorm2d(channels[-1]), nn.LeakyReLU(SLOPE, inplace=True))
        levels = []
        for number in reversed(range(len(channels))):
            count = convs[number] if number else max(1, convs[0] - 1)
            inner = [channels[number]] * (count - 1)
            levels.append(_group([2 * channels[number], *inner, channels[max(0, number - 1)]]))
        self.levels = nn.ModuleList(levels)
        self.colours = nn.ConvTranspose2d(channels[0], 3, 3, padding=1)

    def forward(self, code: Tensor, skips: list[Tensor]) -> Tensor:
        """Codes (B, F) and skip maps (B, C_i, H / 2^i, W / 2^i) to frames (B, 3, H, W), float32 in (0, 1)."""
        x = self.bottom(code[:, :, None, None])
        for level, skip in zip(self.levels, reversed(skips), strict=True):
            x = level(torch.cat((F.interpolate(x, scale_factor=2, mode="nearest"), skip), dim=1))
        return torch.sigmoid(self.colours(x).float())


def _group(widths: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Conv2d(before, after, 3, padding=1), nn.BatchNorm2d(after), nn.LeakyReLU(SLOPE, inplace=True)]
    return nn.Sequential(*layers)


class Gaussian(NamedTuple):
    """Diagonal Gaussians: mean and log sigma^2, each (..., Z)."""

    mean: Tensor
    log_variance: Tensor

    def sample(self, generator: torch.Generator) -> Tensor:
        """mu + sigma eps (..., Z), differentiable in both; eps is drawn on the generator's device."""
        device, dtype = generator.device, self.mean.dtype
        noise = own_noise(
            self.mean.shape, lambda shape: torch.randn(shape, generator=generator, device=device, dtype=dtype)
        )
        return self.mean + (0.5 * self.log_variance).exp() * noise.to(self.mean.device)


class Recurrent(nn.Module):
    """A linear layer and an LSTM of `layers` cells after it."""

    def __init__(self, in_dim: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.embed = nn.Linear(in_dim, hidden)
        self.lstm = nn.LSTM(hidden, hidden, layers, batch_first=True)

    def forward(self, inputs: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """Inputs (B, M, in_dim), M at least 1, to outputs (B, M, hidden) and the state after them; None starts at 0."""
        outputs, after = self.lstm(self.embed(inputs), state)
        return outputs, after


class FramePredictor(nn.Module):
    """LSTM_f: the last frame's code and the latent of the change, to the code that is decoded."""

    def __init__(self, features: int, latent_dim: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.recurrent = Recurrent(features + latent_dim, hidden, layers)
        self.to_code = nn.Linear(hidden, features)

    def forward(self, codes: Tensor, latents: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """h_{t-1} (B, M, F) and z_t (B, M, Z) to g_t (B, M, F) in (-1, 1), and the state after them."""
        with torch.autocast(codes.device.type, enabled=False):
            outputs, after = self.recurrent(torch.cat((codes.float(), latents.float()), dim=-1), state)
            return torch.tanh(self.to_code(outputs)), after


class GaussianLSTM(nn.Module):
    """LSTM_q or LSTM_p: frames' codes to a Gaussian over z after each."""

    def __init__(self, features: int, latent_dim: int, hidden: int) -> None:
        super().__init__()
        self.recurrent = Recurrent(features, hidden, 1)
        self.to_mean = nn.Linear(hidden, latent_dim)
        self.to_log_variance = nn.Linear(hidden, latent_dim)

    def forward(self, codes: Tensor, state: State | None = None) -> tuple[Gaussian, State]:
        """Codes (B, M, F) to Gaussians (B, M, Z), and the state after them."""
        with torch.autocast(codes.device.type, enabled=False):
            outputs, after = self.recurrent(codes.float(), state)
            return Gaussian(self.to_mean(outputs), self.to_log_variance(outputs)), after


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
