"""What the latent actions carry: probes of real actions and of known moves, codebook usage, one row per code. Probes
are tested on whole episodes or clips held out: transitions of one are too alike to stand on both sides.

Shapes: M transitions, Z latent-action dim (N * Z with one latent per slot), A action dim, K prototypes, D width of what
a probe sees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from playslot_rl.modules.inverse_dynamics import InverseDynamics

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
SPREAD = 0.1
"""Least variance of a tested action, share of that it was fitted with: below it R² tells how still the robot stood."""


@torch.no_grad()
def infer_latents(
    model: InverseDynamics,
    slots: npt.NDArray[np.float32],
    starts: Sequence[int] | Ints,
    lengths: Sequence[int] | Ints,
    actions: npt.NDArray[np.float32] | None = None,
) -> tuple[Floats, Ints, Ints]:
    """Latent actions of whole episodes, given by first row and number of frames of slots (F, N, D), and by real actions
    (F, A) in `ground_truth` mode: z (M, Z), codes (M, 1), or (M, N) with one latent per slot, -1 without a codebook,
    and the episode (M,) of each transition. A ValueError where no episode has two frames.
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


def _hold_out(groups: Ints, fraction: float, seed: int, what: str) -> tuple[npt.NDArray[np.bool_], int]:
    """Mask (M,) of the rows of some groups (M,) drawn at random, and how many groups they are: `fraction` of them, at
    least one, and at least one is left. A ValueError where there are fewer than two; `what` says who asks and what a
    group is: `probe_moves: clip`.
    """
    names = np.unique(groups)
    if len(names) < 2:
        who, _, group = what.partition(": ")
        raise ValueError(f"{who}: got {len(names)} {group}, expected at least 2 to hold some out")
    shuffled = np.random.default_rng(seed).permutation(names)
    held = shuffled[: min(len(names) - 1, max(1, round(fraction * len(names))))]
    return np.isin(groups, held), len(held)


def probe_actions(
    z: Floats, actions: Floats, episodes: Ints, codes: Ints | None = None, tested: npt.NDArray[np.bool_] | None = None
) -> dict[str, Any]:
    """How much of the real action (M, A), in [-1, 1], can be read from the latent (M, Z), on episodes that the probe
    has not seen.

    Args:
        codes: (M, C); adds the probe `code`, which sees their one-hot form only.
        tested: (M,) transitions of whole episodes; None holds out a quarter of these, drawn by a fixed seed.

    Returns:
        `linear` (ridge), `mlp` (two layers of 64) and, with codes, `code`: each `r2` (A values; None where the held-out
        action does not vary, or hardly (`SPREAD`)) and `mean_r2`; `train` and `test` count transitions, `test_episodes`
        episodes.

    Raises:
        ValueError: sizes differ, there are fewer than two episodes, or an episode is on both sides.
    """
    if not len(z) == len(actions) == len(episodes):
        raise ValueError(f"probe_actions: got {len(z)}, {len(actions)} and {len(episodes)} rows, expected as many each")
    if tested is None:
        test, test_episodes = _hold_out(episodes, 0.25, 0, "probe_actions: episode")
    else:
        test, test_episodes = tested, len(np.unique(episodes[tested]))
        if not test.any() or test.all() or np.isin(episodes[~test], episodes[test]).any():
            raise ValueError("probe_actions: got no two sets of whole episodes, expected some to fit and some to test")
    result: dict[str, Any] = {"train": int((~test).sum()), "test": int(test.sum()), "test_episodes": test_episodes}
    for name in ("linear", "mlp"):
        result[name] = _score(name, z[~test], actions[~test], z[test], actions[test])
    if codes is not None and codes.size and codes.min() >= 0:
        hot = np.eye(int(codes.max()) + 1, dtype=np.float32)[codes].reshape(len(codes), -1)
        result["code"] = _score("linear", hot[~test], actions[~test], hot[test], actions[test])
    return result


def linear_probe(x: Floats, y: Floats, x_test: Floats, y_test: Floats) -> dict[str, Any]:
    """Ridge regression of actions y (M, A) from features x (M, D), tested on other rows: `r2` and `mean_r2` as of
    `probe_actions`.
    """
    return _score("linear", x, y, x_test, y_test)


def _score(kind: str, x: Floats, y: Floats, x_test: Floats, y_test: Floats) -> dict[str, Any]:
    import warnings

    from sklearn.linear_model import RidgeCV
    from sklearn.neural_network import MLPRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    if kind == "linear":
        model = make_pipeline(StandardScaler(), RidgeCV(alphas=np.logspace(-3, 3, 13)))
    else:
        # Adam with a fixed number of passes: early stopping would need a split by episodes that sklearn does not make.
        net = MLPRegressor(
            hidden_layer_sizes=(64, 64), alpha=1e-3, learning_rate_init=2e-3, batch_size=128, max_iter=60,
            random_state=0, tol=0.0, n_iter_no_change=60,
        )  # fmt: skip
        model = make_pipeline(StandardScaler(), net)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "did not converge" is the fixed number of passes
        model.fit(x, y)
    predicted = np.asarray(model.predict(x_test)).reshape(y_test.shape)
    residual = np.square(y_test - predicted).mean(0)
    spread, least = y_test.var(0), np.maximum(1e-8, SPREAD * y.var(0))
    r2 = [None if s < m else float(1 - e / s) for e, s, m in zip(residual, spread, least, strict=True)]
    known = [v for v in r2 if v is not None]
    return {"r2": r2, "mean_r2": float(np.mean(known)) if known else None}


def probe_moves(features: Floats, moves: Ints, clips: Ints, classes: int, seed: int = 0) -> dict[str, Any]:
    """Accuracy of multinomial logistic regression, from features (M, D) such as the prototype of the object's slot to
    moves (M,) from 0 to `classes` - 1, on clips (M,) that it was not fitted on: 0.3 of them, drawn by the seed.

    `chance` is 1 / classes, `majority` always the most frequent move of the fitted clips; `train` and `test` count
    transitions, `test_clips` clips. A ValueError where sizes differ, or there are fewer than two clips.
    """
    if not len(features) == len(moves) == len(clips):
        raise ValueError(f"probe_moves: got {len(features)}, {len(moves)} and {len(clips)} rows, expected as many each")
    test, test_clips = _hold_out(clips, 0.3, seed, "probe_moves: clip")
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    common = int(np.bincount(moves[~test], minlength=classes).argmax())
    if len(np.unique(moves[~test])) > 1:
        probe = make_pipeline(StandardScaler(), LogisticRegression(C=10.0, max_iter=500))
        predicted = probe.fit(features[~test], moves[~test]).predict(features[test])
    else:
        predicted = np.full(int(test.sum()), common)
    return {
        "accuracy": float((predicted == moves[test]).mean()),
        "majority": float((moves[test] == common).mean()),
        "chance": 1.0 / classes,
        "train": int((~test).sum()),
        "test": int(test.sum()),
        "test_clips": test_clips,
    }


def codebook_usage(codes: Ints, n_prototypes: int) -> dict[str, Any]:
    """`counts` (K) of codes of any shape, `used` (codes chosen at least once), and `perplexity` (1 to K; K when all are
    equally frequent). A ValueError where a code is outside 0 to K - 1.
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
    """A row for each prototype: `code`, `count`, and `mean` (A) and `std` (A) of the real actions (M, A), if it was
    chosen.
    """
    rows: list[dict[str, Any]] = []
    for code in range(n_prototypes):
        chosen = actions[codes == code]
        mean, std = (chosen.mean(0).tolist(), chosen.std(0).tolist()) if len(chosen) else (None, None)
        rows.append({"code": code, "count": len(chosen), "mean": mean, "std": std})
    return rows


def participation_ratio(z: Floats) -> float | None:
    """Effective number of directions in which latents (M, Z) vary: (sum l)^2 / sum l^2 of the eigenvalues l of their
    covariance, from 1 (a line) to Z (the same variance in every direction); None where nothing varies.
    """
    centred = z.astype(np.float64) - z.mean(0, dtype=np.float64)
    # Of the covariance C, without its eigenvalues: (tr C)^2 / tr C^2.
    covariance = centred.T @ centred / max(1, len(z))
    trace, square = float(np.trace(covariance)), float((covariance**2).sum())
    return trace**2 / square if square > 1e-24 else None


def repaired(rows: Ints, sides: npt.NDArray[np.bool_], seed: int) -> Ints:
    """Row numbers (M,) in an order drawn by a seed, each within its side (fitted or tested): wrong pairs on both."""
    generator, order = np.random.default_rng(seed), rows.copy()
    for side in (sides, ~sides):
        order[side] = generator.permutation(rows[side])
    return order
