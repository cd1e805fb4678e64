"""The way in for TorchRL's planners: the imagination environment with a goal's cost as reward, and an action whose
training distribution is standard.

    CEMPlanner(planning_env(...), planning_horizon=H, optim_steps=10, num_candidates=64, top_k=8)(planning_start(...))

Their candidates are called "action" and begin with mean 0 and deviation 1, so the latent actions are renamed and scaled
at once. They are several times slower than our own on the cached rollout (`playslot bench`, `plan_step`), keep no
elites, have no floor of the deviation and draw from the global generator: wrap a call in
`playslot_rl.seeds.draws.global_seed`.

Shapes: M candidates, H horizon, N slots, D slot width, Z latent-action width.
"""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, ObservationNorm, Transform, TransformedEnv

from playslot_rl import keys
from playslot_rl.acting.imagination import ImaginationEnv
from playslot_rl.acting.planners.costs import Distance
from playslot_rl.modules.whitening import Whitening
from playslot_rl.world_model import WorldModel


class GoalReward(Transform):
    """Puts a goal's cost, with weight a of the way, in the place of the reward, so that the sum over a horizon, at
    which the environment truncates, is minus the cost of `GoalCost`.

        r_t = -a / H d(S_t, G) - (1 - a) [t = H] d(S_t, G)
    """

    def __init__(self, distance: Distance, horizon: int, along: float) -> None:
        super().__init__(in_keys=[keys.SLOTS], out_keys=["reward"])
        self.distance, self.horizon, self.along = distance, horizon, along

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        last = next_tensordict.get("truncated").float()
        weight = self.along / self.horizon + (1 - self.along) * last
        return next_tensordict.set("reward", -weight * self.distance(next_tensordict.get(keys.SLOTS))[..., None])

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return tensordict_reset  # there is no reward before the first step

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        reward = Unbounded((*reward_spec.shape, 1), device=reward_spec.device)
        return Composite({"reward": reward}, shape=reward_spec.shape, device=reward_spec.device)


class ReturnAdvantage(TensorDictModuleBase):
    """The advantage that MPPIPlanner weights candidates by: the return from each step on, shifted so that the best
    candidate has 0, in units of the candidates' deviation. Unshifted, all its weights may underflow to NaN.
    """

    in_keys = [("next", "reward")]  # noqa: RUF012 (TensorDictModuleBase declares it so)
    out_keys = ["advantage"]  # noqa: RUF012

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "advantage" (..., M, H, 1)."""
        reward: Tensor = tensordict.get(("next", "reward"))
        returns = reward.flip(-2).cumsum(-2).flip(-2)
        shift, scale = returns.amax(-3, keepdim=True), returns.std(-3, keepdim=True).clamp(min=1e-12)
        return tensordict.set("advantage", (returns - shift) / scale)


def planning_env(
    world_model: WorldModel, distance: Distance, whitening: Whitening, horizon: int, along: float = 0.5
) -> TransformedEnv:
    """The imagination environment for `CEMPlanner` and `MPPIPlanner` (with `ReturnAdvantage`), batch size (). The
    whitening's axes are left out: TorchRL's normalisation is a number for each latent dimension. A ValueError for one
    latent action a slot, which TorchRL's planners cannot hold.
    """
    if len(world_model.latent_shape) > 1:
        raise ValueError("planning_env: got one latent action per slot, expected one a step: use our own planners")
    env = ImaginationEnv(world_model, horizon=horizon)
    scaled = ObservationNorm(
        loc=whitening.mean,
        scale=_deviation(whitening),
        in_keys=[],
        out_keys=[],
        in_keys_inv=[keys.LATENT_ACTION],
        out_keys_inv=["action"],
        standard_normal=True,
    )
    return TransformedEnv(env, Compose(GoalReward(distance, horizon, along), scaled))


def planning_start(env: TransformedEnv, slots: Tensor) -> TensorDictBase:
    """The planners' start from slots (..., N, D), which the transformed environment's own reset would drop."""
    start: TensorDictBase = env.base_env.reset(TensorDict({keys.SLOTS: slots}, slots.shape[:-2]))
    return start


def latent_of(whitening: Whitening, action: Tensor) -> Tensor:
    """A planner's action (..., Z), which is in standard units, as the latent action (..., Z)."""
    return whitening.mean + _deviation(whitening) * action


def _deviation(whitening: Whitening) -> Tensor:
    return (whitening.basis * whitening.scale).square().sum(-1).sqrt()
