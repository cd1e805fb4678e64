"""Golden numbers: outputs of fixed weights on fixed inputs, so that a change of the maths cannot pass unnoticed.

The weights are a formula of their position, not a draw of a random generator, so a change of initialisation or of the
order of construction does not move these numbers; only a change of the computation does. To renew them after an
intended change, run this file as a program and paste what it prints.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from playslot_rl.config import ActionDecoderConfig, InverseDynamicsConfig, PolicyConfig, PredictorConfig, SAViConfig
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.inverse_dynamics import InverseDynamics
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.modules.predictors.cocvp import COCVP
from playslot_rl.modules.savi import SAVi


def wave(*shape: int, phase: float = 0.0) -> Tensor:
    """Numbers in [-1, 1] that look random and are the same everywhere."""
    count = int(torch.tensor(shape).prod())
    index = torch.arange(count, dtype=torch.float64)
    return torch.sin(index * 1.7 + (index * 0.013) ** 2 + phase).reshape(shape)


def fixed[Module: nn.Module](module: Module) -> Module:
    """Double precision, evaluation mode, every parameter set by its position."""
    module = module.double().eval()
    with torch.no_grad():
        for i, (name, parameter) in enumerate(module.named_parameters()):
            scale = 1.0 if "norm" in name and name.endswith("weight") else 0.0
            fan = parameter[0].numel() if parameter.dim() > 1 else 16
            parameter.copy_(scale + wave(*parameter.shape, phase=float(i)) * (1.5 / fan) ** 0.5)
    return module


def savi(decoder: str) -> SAVi:
    full = decoder == "broadcast"
    config = SAViConfig(
        n_slots=3,
        slot_dim=16,
        initial="learned",
        encoder_channels=(8, 8),
        encoder_strides=(1, 1) if full else (2, 2),
        encoder="full" if full else "strided",
        token_dim=16,
        decoder="broadcast" if full else "pixel_shuffle",
        decoder_channels=(8, 8) if full else (8,),
        corrector_mlp=16,
        transition_heads=2,
        transition_mlp=16,
    )
    return fixed(SAVi(config, image_size=16))


def parsed() -> Tensor:
    return savi("broadcast")((wave(1, 3, 3, 16, 16) + 1) / 2)[0]


def latent() -> Tensor:
    config = InverseDynamicsConfig(latent_dim=4, n_prototypes=3, dim=8, layers=1, heads=2, head_dim=4, mlp_dim=16)
    model = fixed(InverseDynamics(config, 16, 4))
    model.quantizer.vq._codebook.initted.fill_(True)
    model.quantizer.vq._codebook.embed.data.copy_(wave(1, 3, 4))
    out = model(wave(2, 4, 3, 16))
    return torch.stack((out.z, out.prototype, out.variability))


def rollout() -> Tensor:
    model = fixed(COCVP(PredictorConfig(dim=16, layers=2, heads=2, head_dim=4, mlp_dim=16, context=4), 16, 4))
    model.code = model.code.double()
    return model.rollout(wave(1, 2, 3, 16), wave(1, 6, 4, phase=1.0), wave(1, 6, 4, phase=2.0))


CASES: dict[str, Callable[[], Tensor]] = {
    "savi slots": parsed,
    "savi frames, broadcast": lambda: savi("broadcast").decode(wave(2, 3, 16)).frames,
    "savi masks, broadcast": lambda: savi("broadcast").decode(wave(2, 3, 16)).masks,
    "savi slots, strided": lambda: savi("pixel_shuffle")((wave(1, 3, 3, 16, 16) + 1) / 2)[0],
    "savi frames, pixel shuffle": lambda: savi("pixel_shuffle").decode(wave(2, 3, 16)).frames,
    "invdyn": latent,
    "cocvp rollout": rollout,
    "policy": lambda: fixed(LatentPolicy(PolicyConfig(8, 1, 2, 4, 16), 16, 4))(wave(2, 3, 16)),
    "action decoder": lambda: fixed(ActionDecoder(ActionDecoderConfig(8), 4, 4))(wave(5, 4)),
}


def summary(out: Tensor) -> tuple[float, float, float]:
    """Mean, root mean square, and a sum whose weights see every position."""
    flat = out.detach().double().flatten()
    weights = wave(flat.numel(), phase=0.5)
    return float(flat.mean()), float(flat.square().mean().sqrt()), float((flat * weights).sum() / len(flat) ** 0.5)


GOLDEN: dict[str, tuple[float, float, float]] = {
    "savi slots": (-0.1083794, 1.2417513, -0.4038812),
    "savi frames, broadcast": (-0.0669058, 0.2478212, -0.0001474),
    "savi masks, broadcast": (0.3333333, 0.3333516, 0.0022743),
    "savi slots, strided": (-0.1088724, 1.2392582, -0.4039064),
    "savi frames, pixel shuffle": (-0.0256071, 0.3165780, -0.0447666),
    "invdyn": (-0.0003331, 0.5410974, 0.0932488),
    "cocvp rollout": (-0.0231051, 0.8297051, -0.2214121),
    "policy": (0.0449217, 1.1650651, 1.8430645),
    "action decoder": (-0.0522994, 0.2138882, -0.5111160),
}


@pytest.mark.parametrize("name", CASES)
def test_outputs_are_the_stored_ones(name: str) -> None:
    assert summary(CASES[name]()) == pytest.approx(GOLDEN[name], rel=1e-4, abs=1e-5)


if __name__ == "__main__":
    for case, compute in CASES.items():
        print(f'    "{case}": ({", ".join(f"{value:.7f}" for value in summary(compute()))}),')
