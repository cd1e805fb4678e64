"""What the latent actions carry: probes of the real action, codebook usage, one row per code.

Shapes: M transitions, Z latent-action dim (N * Z with one latent per slot), A action dim, K prototypes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from playslot_rl.evaluation.hold_out import hold_out
from playslot_rl.modules.inverse_dynamics import InverseDynamics

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]


@torch.no_grad()
def infer_latents(
    model: InverseDynamics,
    slots: npt.NDArray[np.float32],
    starts: Sequence[int] | Ints,
    lengths: Sequence[int] | Ints,
    actions: npt.NDArray[np.float32] | None = None,
) -> tuple[Floats, Ints, Ints]:
    """Latent actions of whole episodes.

    Args:
        model: InvDyn, in evaluation mode.
        slots: (F, N, D) cached slots of all frames.
        starts: first row of each episode.
        lengths: frames of each episode.
        actions: (F, A) real actions; needed in `ground_truth` mode only.

    Returns:
        z (M, Z), or (M, N * Z) with one latent per slot; codes (M, 1) or (M, N), -1 without a codebook;
        episode index (M,). M counts the transitions: lengths minus one, summed.
    """
    device = next(iter(model.parameters()), torch.zeros(())).device
    z, codes, episodes = [], [], []
    for episode, (start, length) in enumerate(zip(starts, lengths, strict=True)):
        if length < 2:
            continue
        clip = torch.from_numpy(np.array(slots[start : start + length])).to(device)[None]
        real = None
        if actions is not None:
            real = torch.from_numpy(np.array(actions[start : start + length - 1])).to(device)[None]
        latents = model(clip, real)
        z.append(latents.z[0].reshape(length - 1, -1).cpu().numpy())
        code = latents.code[0].reshape(length - 1, -1).cpu().numpy()
        codes.append(code if model.n_prototypes else np.full_like(code, -1))
        episodes.append(np.full(length - 1, episode, np.int64))
    if not z:
        raise ValueError("infer_latents: got no episode of two frames or more, expected at least one")
    return np.concatenate(z), np.concatenate(codes), np.concatenate(episodes)


def probe_actions(
    z: Floats, actions: Floats, episodes: Ints, seed: int = 0, held_out: float = 0.25, codes: Ints | None = None
) -> dict[str, Any]:
    """How much of the real action can be read from the latent, on episodes the probe has not seen.

    Args:
        z: (M, Z) latents.
        actions: (M, A) real actions in [-1, 1].
        episodes: (M,) episode of each transition; whole episodes are held out.
        seed: of the split and of the non-linear probe.
        held_out: fraction of episodes held out.
        codes: (M, C) codes; adds the probe `code`, which sees their one-hot form only.

    Returns:
        `linear` (ridge), `mlp` (two layers of 64) and, with codes, `code`: each `r2` (A values; None where the held-out
        action does not vary) and `mean_r2`; `train` and `test` count transitions, `test_episodes` episodes.

    Raises:
        ValueError: sizes differ, or there are fewer than two episodes.
    """
    if not len(z) == len(actions) == len(episodes):
        raise ValueError(f"probe_actions: got {len(z)}, {len(actions)} and {len(episodes)} rows, expected as many each")
    test, test_episodes = hold_out(episodes, held_out, seed, "probe_actions: episode")
    result: dict[str, Any] = {"train": int((~test).sum()), "test": int(test.sum()), "test_episodes": test_episodes}
    for name in ("linear", "mlp"):
        result[name] = _score(name, z[~test], actions[~test], z[test], actions[test], seed)
    if codes is not None and codes.size and codes.min() >= 0:
        hot = np.eye(int(codes.max()) + 1, dtype=np.float32)[codes].reshape(len(codes), -1)
        result["code"] = _score("linear", hot[~test], actions[~test], hot[test], actions[test], seed)
    return result


def _score(kind: str, x: Floats, y: Floats, x_test: Floats, y_test: Floats, seed: int) -> dict[str, Any]:
    from sklearn.linear_model import RidgeCV
    from sklearn.neural_network import MLPRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    if kind == "linear":
        model = make_pipeline(StandardScaler(), RidgeCV(alphas=np.logspace(-3, 3, 13)))
    else:
        # Adam with a fixed number of passes: early stopping would need a split by episodes that sklearn does not make.
        net = MLPRegressor(
            hidden_layer_sizes=(64, 64),
            alpha=1e-3,
            learning_rate_init=2e-3,
            batch_size=128,
            max_iter=60,
            random_state=seed,
        )
        net.set_params(tol=0.0, n_iter_no_change=60)
        model = make_pipeline(StandardScaler(), net)
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "did not converge" is the fixed number of passes
        model.fit(x, y)
    predicted = np.asarray(model.predict(x_test)).reshape(y_test.shape)
    residual = np.square(y_test - predicted).mean(0)
    spread = y_test.var(0)
    r2 = [None if s < 1e-8 else float(1 - e / s) for e, s in zip(residual, spread, strict=True)]
    known = [v for v in r2 if v is not None]
    return {"r2": r2, "mean_r2": float(np.mean(known)) if known else None}


def codebook_usage(codes: Ints, n_prototypes: int) -> dict[str, Any]:
    """How often each prototype is chosen.

    Args:
        codes: any shape, values from 0 to K - 1.
        n_prototypes: K.

    Returns:
        `counts` (K), `used` (codes chosen at least once), `perplexity` (1 to K; K when all are equally frequent).

    Raises:
        ValueError: a code is outside its range.
    """
    flat = np.asarray(codes).reshape(-1)
    if flat.size == 0 or flat.min() < 0 or flat.max() >= n_prototypes:
        raise ValueError(f"codebook_usage: got {flat.size} codes, expected some, all from 0 to {n_prototypes - 1}")
    counts = np.bincount(flat, minlength=n_prototypes)
    p = counts[counts > 0] / flat.size
    return {
        "counts": counts.tolist(),
        "used": int((counts > 0).sum()),
        "perplexity": float(math.exp(-(p * np.log(p)).sum())),
    }


def code_table(codes: Ints, actions: Floats, n_prototypes: int) -> list[dict[str, Any]]:
    """Mean and standard deviation of the real action for each code.

    Args:
        codes: (M,) code of each transition.
        actions: (M, A) real actions in [-1, 1].
        n_prototypes: K.

    Returns:
        K rows: `code`, `count`, `mean` (A) and `std` (A); both None for a code that was never chosen.
    """
    rows: list[dict[str, Any]] = []
    for code in range(n_prototypes):
        chosen = actions[codes == code]
        empty = len(chosen) == 0
        rows.append(
            {
                "code": code,
                "count": len(chosen),
                "mean": None if empty else chosen.mean(0).tolist(),
                "std": None if empty else chosen.std(0).tolist(),
            }
        )
    return rows
